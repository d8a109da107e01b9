"""What is wrong with the files of a clip folder: one diagnostic for each file, and summaries."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.clip_folder.format import ClipHeader
from hoigs.core.diagnostics import Diagnostic, ranges

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
