"""The clip folder's checker: every absent or inconsistent file, and its maker."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from hoigs.core.clip_folder.format import (
    BODY,
    CAMERAS,
    DEPTH,
    HEADER,
    IGNORED,
    IMAGE,
    MASK,
    OBJECT,
    POINTS,
    VIEWS,
    ClipHeader,
    FileSpec,
    ViewsHeader,
    depth_path,
    ignored_path,
    image_path,
    mask_path,
    parse_header,
)
from hoigs.core.errors import ClipError
from hoigs.core.reporting import Diagnostic, Severity, ranges
from hoigs.core.system.files import regular_file
from hoigs.core.system.npz import ArrayHeader, array_headers, load_arrays

# What is wrong with the files of a clip folder: one diagnostic for each file, and summaries.


# what training does without a file of each folder, where it can do without
WITHOUT = {
    "images": "the frame is neither trained on nor scored",
    "masks": "the entity is not compared with the video there",
    "depth": "no depth is compared there",
}
MISSING = {"images": "missing-frames", "masks": "missing-masks", "depth": "missing-depth"}


@dataclass(frozen=True)
class FileDiagnostic(Diagnostic):
    """A defect of one file of a clip folder.

    `kind` is "absent", "unreadable" (nothing in the file can be used), "inconsistent",
    "empty-masks" or "nan-depth"; `severity` is "fair" where training can go on without what is
    wrong (`--allow-faults`), else "bad".

    Attributes:
        path: the file, relative to the clip folder.
        pixels: of a depth map, how many are NaN, infinite or negative.
    """

    path: str = ""
    pixels: int = 0

    @property
    def unusable(self) -> bool:
        """Whether nothing in the file can be used, and training can do without it."""
        return self.severity == "fair" and self.kind in ("absent", "unreadable")

    def __str__(self) -> str:
        return _line(self.path, self)


def wrong(path: str, what: str) -> FileDiagnostic:
    """Inconsistent content, with which a clip cannot be used."""
    return FileDiagnostic("inconsistent", what, severity="bad", path=path)


def absent(path: str, maker: str) -> FileDiagnostic:
    """An absent file, without which a clip cannot be used, and its maker."""
    return FileDiagnostic("absent", "is absent", maker, severity="bad", path=path)


def _line(names: str, found: FileDiagnostic, verb: str = "is") -> str:
    return f"{names} {verb} absent: {found.do}" if found.kind == "absent" else (
        f"{names}: {found.what}")  # fmt: skip


def _numbered(path: str) -> tuple[str, str]:
    """Folder and suffix of a numbered file; a path and "" of any other."""
    file = Path(path)
    return (str(file.parent), file.suffix) if file.stem.isdigit() else (path, "")


def _names(folder: str, suffix: str, frames: Iterable[int]) -> str:
    """masks/ann/{00001,00003-00005}.png"""
    numbers = ranges(frames, most=10**6, digits=5).replace(", ", ",")
    return f"{folder}/{{{numbers}}}{suffix}" if "," in numbers else f"{folder}/{numbers}{suffix}"


def _frame(found: FileDiagnostic) -> int:
    return int(Path(found.path).stem)


def summarize(found: Iterable[FileDiagnostic]) -> list[str]:
    """One line for each diagnostic; numbered files of a folder with one message share a line."""
    groups: dict[tuple[str, str, str, str, bool], list[FileDiagnostic]] = {}
    for one in found:
        key = (*_numbered(one.path), one.what, one.do, one.kind == "absent")
        groups.setdefault(key, []).append(one)
    lines = []
    for (folder, suffix, *_), group in groups.items():
        if len(group) == 1:
            lines.append(str(group[0]))
        else:
            names = _names(folder, suffix, map(_frame, group))
            lines.append(_line(f"{names} ({len(group)} files)", group[0], "are"))
    return lines


def summarized_for_training(
    found: Iterable[FileDiagnostic], header: ClipHeader
) -> list[Diagnostic]:
    """What training goes on without: one diagnostic for each folder and kind of defect."""
    groups: dict[tuple[str, str], list[FileDiagnostic]] = {}
    for one in found:
        folder, suffix = _numbered(one.path)
        defect = {"nan-depth": "have pixels without a depth", "absent": "are absent"}.get(
            one.kind, "cannot be read" if suffix else one.what
        )
        groups.setdefault((folder, defect), []).append(one)
    return [_of_group(folder, defect, group, header) for (folder, defect), group in groups.items()]


def _of_group(
    folder: str, defect: str, group: list[FileDiagnostic], header: ClipHeader
) -> Diagnostic:
    first, part = group[0], folder.removeprefix("held_out/").split("/")[0]
    if first.kind == "empty-masks":
        return Diagnostic(first.kind, f"{folder}: {defect}", f"make them again; {WITHOUT[part]}")
    frames = tuple(map(_frame, group))
    names = _names(folder, Path(first.path).suffix, frames)
    what = f"{names} ({len(group)} of {header.frames}) {defect}"
    if first.kind == "nan-depth":
        share = sum(one.pixels for one in group) / (header.width * header.height * len(group))
        what += f" (NaN, infinite or negative: {100 * share:.1f} %)"
        do = "write 0 where depth is unknown; these pixels count as unknown"
        return Diagnostic("nan-depth", what, do, frames)
    return Diagnostic(MISSING[part], what, f"{first.do or first.what}; {WITHOUT[part]}", frames)


# Checks of the clip folder's npz files: shapes, numbers, cameras, rotations and colours.

ROTATION_TOLERANCE = 1e-3  # of R R^T - I, generous to float16 and text files
LARGEST = 1e7  # absolute value of any number: float32 has no centimetres left there
MOST_TEXT = 100_000


def check_arrays(
    folder: Path, path: str, spec: FileSpec, sizes: dict[str, int]
) -> tuple[list[FileDiagnostic], dict[str, np.ndarray]]:
    """Problems, and the arrays that are as they should be."""
    if not (folder / path).is_file():
        return [absent(path, spec.maker)], {}
    try:
        headers = array_headers(folder / path)
        problems = list(_header_problems(path, spec, headers, sizes))
        wanted = {a.name for a in spec.arrays} - {p.what.split(" ", 1)[0] for p in problems}
        arrays = load_arrays(folder / path, wanted)
    except (OSError, ValueError) as error:
        return [wrong(path, str(error))], {}
    good = {}
    for name, values in arrays.items():
        defect = _content_problem(values)
        if defect:
            problems.append(wrong(path, f"{name} {defect}"))
        else:
            good[name] = values
    return problems, good


def _header_problems(
    path: str, spec: FileSpec, headers: Mapping[str, ArrayHeader], sizes: dict[str, int]
) -> Iterator[FileDiagnostic]:
    """Absent arrays, and shapes and dtypes that are wrong; each message begins with a name."""
    for array in spec.arrays:
        if array.name in headers:
            defect = _array_problem(headers[array.name], array.shape, array.kind, sizes)
            if defect:
                yield wrong(path, f"{array.name} {defect}")
        elif not array.optional:
            yield wrong(path, f"has no array {array.name!r} ({array.meaning}); {spec.maker}")


def _array_problem(
    got: ArrayHeader, shape: tuple[int | str, ...], kind: str, sizes: dict[str, int]
) -> str | None:
    kinds = {"float": "f", "bool": "b", "str": "U"}
    if got.dtype.kind != kinds[kind]:
        return f"is {got.dtype}, expected {kind}"
    expected = [
        sizes.setdefault(s, n) if isinstance(s, str) else s for s, n in zip(shape, got.shape)
    ]
    if len(got.shape) != len(shape) or list(got.shape) != expected:
        named = ", ".join(f"{s}={sizes[s]}" if s in sizes else str(s) for s in shape)
        frames = bool(shape) and shape[0] == "F" and len(got.shape) == len(shape)
        count = f": {got.shape[0]} entries for {sizes['F']} frames" if frames else ""
        return f"has shape {list(got.shape)}, expected [{named}]{count}"
    if kind == "str" and got.nbytes > MOST_TEXT:
        return f"is a text of {got.nbytes} bytes, at most {MOST_TEXT} are read"
    return None


def _content_problem(got: np.ndarray) -> str | None:
    if got.dtype.kind != "f" or not got.size:
        return None
    bad = int((~np.isfinite(got)).sum())
    if bad:
        return f"has {bad} values that are NaN or infinite"
    largest = float(np.abs(got).max())
    if largest > LARGEST:
        return f"has values up to {largest:.3g}, at most {LARGEST:g} (metres, pixels) make sense"
    return None


def check_cameras(path: str, arrays: dict[str, np.ndarray]) -> Iterator[FileDiagnostic]:
    """Intrinsics without skew, focal lengths above zero, and rigid world_to_camera."""
    if "K" in arrays:
        K = arrays["K"]
        bad = (K[:, 0, 0] <= 0) | (K[:, 1, 1] <= 0) | (np.abs(K[:, 2] - [0, 0, 1]).max(-1) > 1e-5)
        bad |= (np.abs(K[:, 0, 1]) > 1e-3) | (np.abs(K[:, 1, 0]) > 1e-3)
        if bad.any():
            form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"
            yield wrong(path, f"K of {_frames(bad)} is not {form}")
    if "world_to_camera" in arrays:
        w2c = arrays["world_to_camera"]
        yield from _check_rotations(path, "world_to_camera", w2c[:, :3, :3])
        bad = np.abs(w2c[:, 3] - [0, 0, 0, 1]).max(-1) > 1e-5
        if bad.any():
            yield wrong(path, f"world_to_camera of {_frames(bad)}: last row is not 0 0 0 1")


def _check_rotations(path: str, name: str, rotations: np.ndarray) -> Iterator[FileDiagnostic]:
    R = rotations.astype(np.float64)
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    bad = (off > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    if bad.any():
        message = f"{name} of {_frames(bad)} is not a rotation (orthonormal, determinant +1)"
        yield wrong(path, f"{message}; largest |R R^T - I| is {off.max():.3g}")


def _frames(bad: np.ndarray) -> str:
    numbers = np.flatnonzero(bad).tolist()
    return f"frame {numbers[0]}" if len(numbers) == 1 else (
        f"{len(numbers)} frames ({ranges(numbers)})")  # fmt: skip


def check_colors(path: str, arrays: dict[str, np.ndarray]) -> Iterator[FileDiagnostic]:
    """Points with colours in [0, 1]."""
    if "points" in arrays and len(arrays["points"]) == 0:
        yield wrong(path, "points is empty; at least one point is needed to start from")
    colors = arrays.get("colors")
    if colors is not None and len(colors) and (colors.min() < 0 or colors.max() > 1):
        spread = f"{colors.min():.3g}..{colors.max():.3g}"
        yield wrong(path, f"colors span {spread}, expected RGB in [0, 1]; divide bytes by 255")


def check_track(
    path: str, arrays: dict[str, np.ndarray], body: str | None
) -> Iterator[FileDiagnostic]:
    """A body's or an object's track; `body` is the model that clip.json names for it."""
    if "rotations" in arrays:
        yield from _check_rotations(path, "rotations", arrays["rotations"])
    yield from check_colors(path, arrays)
    if "observed" in arrays and not arrays["observed"].any():
        yield wrong(path, "observed is False in every frame: the object was never seen")
    convention = str(arrays.get("hand_pose_convention", "flat"))
    if convention not in ("flat", "mean"):
        yield wrong(path, f'hand_pose_convention is {convention!r}, expected "flat" or "mean"')
    if body and "model" in arrays and str(arrays["model"]) != body:
        yield wrong(path, f"model is {arrays['model']!s}, but clip.json has {body}")


# Checks of what a clip folder has of each frame: image, masks and depth.

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


RATE_TOLERANCE = 0.01  # of fps, against the mean rate of times
_HEADER_FROM = "clip.json comes from `hoigs prepare VIDEO --out FOLDER` or ClipWriter"


def check_clip(folder: Path) -> list[FileDiagnostic]:
    """Everything wrong with a clip folder, in reading order; empty when it can be used.

    Reads every header and depth map, and masks until one is not empty; images by header only.
    """
    folder = Path(folder)
    if not (folder / HEADER).is_file():
        return [absent(HEADER, _HEADER_FROM)]
    header, messages = parse_header(folder / HEADER, ClipHeader)
    if header is None:
        return [wrong(HEADER, message) for message in messages]
    problems = [*_check_split(header), *_check_times(header), *_check_truth(folder, header)]
    view = View("", header.width, header.height, header.frames)
    problems += check_views(folder, view, header)
    sizes = {"F": header.frames}
    for name, entity in header.entities.items():
        spec, subfolder = (BODY, "bodies") if entity.kind == "human" else (OBJECT, "objects")
        path = f"{subfolder}/{name}.npz"
        found, arrays = check_arrays(folder, path, spec, dict(sizes))
        problems += found
        problems += check_track(path, arrays, entity.body)
    found, arrays = check_arrays(folder, POINTS.pattern, POINTS, dict(sizes))
    problems += [*found, *check_colors(POINTS.pattern, arrays)]
    if (folder / "held_out").exists():
        problems += _check_held_out(folder, header)
    return problems


def require_clip(folder: Path) -> ClipHeader:
    """The header of a clip folder that can be used.

    Raises:
        ClipError: naming every absent or inconsistent file and who makes it.
    """
    return usable_clip(folder)[0]


def usable_clip(
    folder: Path, allow_faults: bool = False
) -> tuple[ClipHeader, list[FileDiagnostic]]:
    """The header of a clip folder that can be used, and what training has to go on without.

    Args:
        allow_faults: accept what training can go on without (severity "fair").

    Raises:
        ClipError: naming every absent or inconsistent file and who makes it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ClipError(f"{folder} is not a folder; make a clip with `hoigs prepare VIDEO --out …`")
    problems = check_clip(folder)
    fatal = [p for p in problems if not allow_faults or p.severity == "bad"]
    if fatal:
        lines = [f"  {line}" for line in summarize(fatal)]
        if all(p.severity == "fair" for p in fatal):
            lines.append("or continue without these: --allow-faults (docs/reference/clip.md)")
        raise ClipError(f"{folder} cannot be used as a clip:\n" + "\n".join(lines))
    header, _ = parse_header(folder / HEADER, ClipHeader)
    assert header is not None  # check_clip has just read it
    return header, problems


def _check_split(header: ClipHeader) -> Iterator[FileDiagnostic]:
    train, test = header.split.train, header.split.test
    if not train:
        yield wrong(HEADER, "split.train is empty: nothing to train on")
    if not test and header.frames > 2:
        yield wrong(HEADER, "split.test is empty: nothing to score on")
    outside = sorted({i for i in (*train, *test) if not 0 <= i < header.frames})
    if outside:
        last = header.frames - 1
        yield wrong(HEADER, f"split names frames {ranges(outside)}; the clip has 0..{last}")
    both = sorted(set(train) & set(test))
    if both:
        yield wrong(HEADER, f"split has frames {ranges(both)} in both train and test")


def _check_times(header: ClipHeader) -> Iterator[FileDiagnostic]:
    times = header.times
    if times is None:
        return
    if len(times) != header.frames or len(times) < 2:
        yield wrong(HEADER, f"times has {len(times)} entries for {header.frames} frames")
        return
    gaps = np.diff(times)
    if times[0] != 0 or not np.isfinite(times).all() or gaps.min() <= 0:
        yield wrong(HEADER, "times has to begin with 0 and to ascend, in seconds")
        return
    rate = len(gaps) / times[-1]
    if abs(rate / header.fps - 1) > RATE_TOLERANCE:
        yield wrong(HEADER, f"fps is {header.fps:g}, but times have {rate:g} frames a second")


def _check_truth(folder: Path, header: ClipHeader) -> Iterator[FileDiagnostic]:
    """The true geometry that synthetic clips name: opened by the evaluation, after training."""
    name = header.provenance.get("truth")
    if name is None:
        return
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        yield wrong(name, "is a link that leaves the clip's folder; copy the file into it")
    elif path.is_file():  # without it, errors against the truth are not computed
        try:
            array_headers(path)
        except (OSError, ValueError) as error:
            yield wrong(name, str(error))


def _check_held_out(folder: Path, header: ClipHeader) -> list[FileDiagnostic]:
    if not (folder / VIEWS).is_file():
        maker = "it comes from ClipWriter.add_held_out; or delete the folder held_out"
        return [absent(VIEWS, maker)]
    views, messages = parse_header(folder / VIEWS, ViewsHeader)
    if views is None:
        return [wrong(VIEWS, message) for message in messages]
    problems = []
    outside = sorted({i for i in views.frames if not 0 <= i < header.frames})
    if outside:
        message = f"frames names {outside}; the clip has 0..{header.frames - 1}"
        problems.append(wrong(VIEWS, message))
    view = View("held_out/", views.width, views.height, len(views.frames))
    return problems + check_views(folder, view, header)
