"""Checks of what a clip folder has of each frame: image, masks and depth."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from hoigs.core.clip_folder.check_arrays import check_arrays, check_cameras
from hoigs.core.clip_folder.diagnostics import FileDiagnostic, absent, wrong
from hoigs.core.clip_folder.format import (
    CAMERAS,
    DEPTH,
    IGNORED,
    IMAGE,
    MASK,
    ClipHeader,
    FileSpec,
    depth_path,
    ignored_path,
    image_path,
    mask_path,
)
from hoigs.core.diagnostics import Severity
from hoigs.core.files.npz import array_headers, load_arrays
from hoigs.core.files.regular_file import regular_file

TAIL = 1024  # bytes in which an image file ends, whatever a program wrote after it
MOST_ABSENT = 10_000  # images; where more are absent, the number of frames is wrong


@dataclass(frozen=True)
class View:
    """The main frames (folder "") or the held-out ones (folder "held_out/")."""

    folder: str
    width: int
    height: int
    count: int


def check_views(folder: Path, view: View, header: ClipHeader) -> list[FileDiagnostic]:
    """Cameras, images, masks and depth of the main frames or of the held-out ones."""
    root, path = folder / view.folder, view.folder + CAMERAS.pattern
    problems, arrays = check_arrays(folder, path, CAMERAS, {"F": view.count})
    problems += check_cameras(path, arrays)
    present = _files_in(root / "images")
    if view.count > present + MOST_ABSENT:
        message = f"{view.count} frames are declared, but images/ holds {present} files"
        return [*problems, wrong(view.folder + "images", message)]
    problems += _each_frame(root, view, image_path, IMAGE, _image_problem)
    for name in header.entities:
        at = functools.partial(_mask_at, name)
        found = _each_frame(root, view, at, MASK, _mask_problem)
        problems += found or _check_mask_content(root, view, name)
    problems += _each_frame(root, view, ignored_path, IGNORED, _mask_problem, optional=True)
    if header.depth_kind != "none":
        problems += _each_frame(root, view, depth_path, DEPTH, _depth_problem)
    return problems


def _files_in(folder: Path) -> int:
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return sum(1 for _ in entries)
    return 0


def _mask_at(entity: str, folder: Path, frame: int) -> Path:
    return mask_path(folder, entity, frame)


def _each_frame(
    root: Path,
    view: View,
    path_of: Callable[[Path, int], Path],
    spec: FileSpec,
    check: Callable[[Path, View], str | FileDiagnostic | None],
    optional: bool = False,
) -> list[FileDiagnostic]:
    """Absent and unreadable files of all frames; training can do without all but optional ones."""

    def one(frame: int) -> FileDiagnostic | None:
        path = path_of(root, frame)
        name = view.folder + path.relative_to(root).as_posix()
        if not path.is_file():
            return None if optional else replace(absent(name, spec.maker), severity="fair")
        found = check(path, view)
        if isinstance(found, FileDiagnostic):
            return replace(found, path=name)
        severity: Severity = "bad" if optional else "fair"
        return FileDiagnostic("unreadable", found, severity=severity, path=name) if found else None

    with ThreadPoolExecutor(4) as pool:  # decompression releases the interpreter lock
        return [p for p in pool.map(one, range(view.count)) if p]


def _image_problem(path: Path, view: View) -> str | None:
    try:
        with Image.open(regular_file(path)) as image:
            size, mode = image.size, image.mode
            if not _ends(path):
                image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        return f"not a readable image ({error})"
    if size != (view.width, view.height):
        return f"is {size[0]}x{size[1]}, expected {view.width}x{view.height}"
    return None if mode in ("RGB", "L", "1", "P", "RGBA") else f"has mode {mode}, expected 8 bit"


def _ends(path: Path) -> bool:
    """Whether a PNG or JPEG has its last marker, which a half-copied file lacks: far quicker than
    decoding all frames."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL))
        tail = file.read()
    return b"IEND" in tail or b"\xff\xd9" in tail


def _mask_problem(path: Path, view: View) -> str | None:
    message = _image_problem(path, view)
    if message:
        return message
    with Image.open(path) as image:
        mode = image.mode
    return None if mode in ("L", "1") else f"has mode {mode}, expected one grey channel, 0 or 255"


def _check_mask_content(root: Path, view: View, entity: str) -> list[FileDiagnostic]:
    brightest = 0
    for frame in range(view.count):
        try:
            with Image.open(regular_file(mask_path(root, entity, frame))) as image:
                brightest = max(brightest, int(np.asarray(image.convert("L")).max()))
        except (OSError, ValueError, SyntaxError) as error:
            name = f"{view.folder}masks/{entity}/{frame:05d}.png"
            message = f"cannot be decoded ({error})"
            return [FileDiagnostic("unreadable", message, path=name)]
        if brightest > 127:
            return []
    hint = f" (the brightest pixel is {brightest}: write 255)" if brightest else ""
    message = f'"{entity}" is seen in no frame: every mask is empty{hint}'
    # an entity may well be out of the held-out cameras' sight
    path = f"masks/{entity}"
    return [] if view.folder else [FileDiagnostic("empty-masks", message, path=path)]


def _depth_problem(path: Path, view: View) -> str | FileDiagnostic | None:
    try:
        headers = array_headers(path)
        header = headers.get("depth")
        if header is None:
            return f'has no array "depth"; it has {sorted(headers)[:8]}'
        if header.shape != (view.height, view.width):
            return f"depth has shape {list(header.shape)}, expected [{view.height}, {view.width}]"
        if header.dtype.kind != "f":
            return f"depth is {header.dtype}, expected float32 or float16 in metres"
        depth = load_arrays(path, ("depth",))["depth"]
    except (OSError, ValueError) as error:
        return str(error)
    for name, count in (
        ("NaN", int(np.isnan(depth).sum())),
        ("infinite", int(np.isinf(depth).sum())),
        ("negative", int((depth < 0).sum())),
    ):
        if count:
            message = f"{count} {name} pixels; write 0 where depth is unknown"
            bad = int((~np.isfinite(depth) | (depth < 0)).sum())
            return FileDiagnostic("nan-depth", message, pixels=bad)
    return None
