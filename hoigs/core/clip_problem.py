"""Problem: one thing wrong with a clip folder; many of them in few lines, or as faults."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.clip_format import ClipHeader
from hoigs.core.fault import Fault


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a clip folder.

    Attributes:
        path: the file, relative to the folder.
        message: what is wrong and what to do; for an absent file, who makes it.
        absent: the file is not there.
        instead: what training does without it under `--allow-faults`; None if it cannot go on.
        lost: the file has nothing that could be used.
        pixels: how many of a depth map's are no depth.
    """

    path: str
    message: str
    absent: bool = False
    instead: str | None = None
    lost: bool = False
    pixels: int = 0

    def __str__(self) -> str:
        return f"{self.path} is absent: {self.message}" if self.absent else _joined(self)


def _joined(problem: Problem) -> str:
    return f"{problem.path}: {problem.message}"


def summarize(problems: Iterable[Problem]) -> list[str]:
    """One line a problem; numbered files of one folder with one message share a line."""
    groups: dict[tuple[str, str, str, bool], list[str]] = {}
    for p in problems:
        path = Path(p.path)
        numbered = path.stem.isdigit()
        room = str(path.parent) if numbered else p.path
        key = (room, path.suffix if numbered else "", p.message, p.absent)
        groups.setdefault(key, []).append(path.stem)
    lines = []
    for (room, suffix, message, absent), stems in groups.items():
        if len(stems) == 1:
            path_name = f"{room}/{stems[0]}{suffix}" if suffix else room
            lines.append(str(Problem(path_name, message, absent)))
        else:
            names = f"{room}/{_ranges(stems)}{suffix} ({len(stems)} files)"
            lines.append(f"{names} are absent: {message}" if absent else f"{names}: {message}")
    return lines


def as_faults(problems: Iterable[Problem], header: ClipHeader) -> list[Fault]:
    """Problems that were let pass, one fault a room and kind: "NaN depth", "absent masks" …"""
    groups: dict[tuple[str, str], list[Problem]] = {}
    for p in problems:
        assert p.instead is not None  # the others were not let pass
        path = Path(p.path)
        numbered = path.stem.isdigit()
        room = str(path.parent) if numbered else p.path
        said = "have pixels without a depth" if p.pixels else "are absent"
        if not p.pixels and not p.absent:
            said = "cannot be read" if numbered else p.message
        groups.setdefault((room, said), []).append(p)
    return [_fault(room, said, found, header) for (room, said), found in groups.items()]


def _fault(room: str, said: str, found: list[Problem], header: ClipHeader) -> Fault:
    stems = [Path(p.path).stem for p in found]
    frames = tuple(int(s) for s in stems if s.isdigit())
    first = found[0]
    if not frames:
        return Fault("empty-masks", f"{room}: {said}", f"make them again; {first.instead}")
    names = f"{room}/{_ranges(stems)}{Path(first.path).suffix}"
    kind = Path(room).parts[0] if not room.startswith("held_out") else Path(room).parts[1]
    what = f"{names} ({len(found)} of {header.frames}) {said}"
    mend = first.message
    if first.pixels:
        share = sum(p.pixels for p in found) / (header.width * header.height * len(found))
        what, mend = (
            f"{what} (NaN, infinite or negative: {100 * share:.1f} %)",
            "write 0 where depth is unknown",
        )
    kinds = {"images": "missing-frames", "masks": "missing-masks", "depth": "missing-depth"}
    return Fault(
        "nan-depth" if first.pixels else kinds[kind], what, f"{mend}; {first.instead}", frames
    )


def _ranges(stems: list[str]) -> str:
    numbers = sorted({int(s) for s in stems})
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    text = [f"{a:05d}" if a == b else f"{a:05d}-{b:05d}" for a, b in runs]
    return text[0] if len(text) == 1 else "{" + ",".join(text) + "}"
