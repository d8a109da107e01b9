"""What a COLMAP model's files say without COLMAP: which models there are, and images' names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

PARTS = ("cameras", "images", "points3D")


def models_in(sparse: Path) -> dict[str, int]:
    """Names of the model folders in `sparse`, in order of their numbers, and how many images each
    registers; "" is `sparse` itself, which comes last. COLMAP writes a model for each part of a
    scene that it cannot join to the others."""
    folders = [p for p in sparse.iterdir() if p.is_dir()] if sparse.is_dir() else []
    folders.sort(key=lambda p: (len(p.name), p.name))
    found = {p.name: p for p in folders} | {"": sparse}
    return {name: registered_images(p) for name, p in found.items() if holds_model(p)}


def holds_model(folder: Path) -> bool:
    """Whether a file of a model is there, complete or not."""
    return any((folder / f"{p}.{s}").is_file() for p in PARTS for s in ("bin", "txt"))


def is_binary(model: Path) -> bool:
    """Whether COLMAP reads the binary files: it prefers them, if all are there."""
    return all((model / f"{part}.bin").is_file() for part in PARTS)


def registered_images(model: Path) -> int:
    """Images in a model; 0 if it does not say."""
    try:
        if (model / "images.bin").is_file():
            with (model / "images.bin").open("rb") as file:
                return int.from_bytes(file.read(8), "little")
        return len(text_names(model / "images.txt"))
    except (OSError, ValueError):
        return 0


def text_names(path: Path) -> dict[int, str]:
    """Names of the images in an images.txt, whole, by number. COLMAP ends one at its first space.

    Raises:
        ValueError: a row is not that of an image.
    """
    names = {}
    for row in _headers(path.read_text(encoding="utf-8").splitlines()):
        fields = row.split(maxsplit=9)
        if len(fields) < 10:
            raise ValueError(f"{path}: expected ten fields, came {row[:80]!r}")
        names[int(fields[0])] = fields[9]
    return names


def _headers(lines: list[str]) -> Iterator[str]:
    """The first of each image's two lines; the second, its observations, may be empty."""
    rows = iter(lines)
    for line in rows:
        row = line.strip()
        if row and not row.startswith("#"):
            yield row
            next(rows, None)


def text_models(path: Path) -> set[str]:
    """Names of the camera models in a cameras.txt."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return {m[1] for line in lines if (m := re.match(r"\s*\d+\s+(\w+)", line))}


def choice_told(sparse: Path, chosen: Path) -> str | None:
    """A sentence on which of several models was chosen; None if there is one."""
    found = {f"{sparse.name}/{n}".rstrip("/"): count for n, count in models_in(sparse).items()}
    if len(found) < 2:
        return None
    counts = ", ".join(f"{name} ({count} images)" for name, count in found.items())
    name = chosen.relative_to(sparse.parent).as_posix()
    return f"{sparse.parent} holds several COLMAP models: {counts}; {name} is used"
