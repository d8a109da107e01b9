"""Fault: one thing wrong with a clip that training can go on with."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Fault:
    """What is wrong, and what to do about it.

    Attributes:
        kind: a short name for tests and tables: "empty-masks", "depth-scale" …
        what: what was found, where and how much of it.
        do: what a user can do, and what training does meanwhile.
        frames: that have it; () where it is of the whole clip.
    """

    kind: str
    what: str
    do: str
    frames: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.what}: {self.do}"

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "what": self.what, "do": self.do, "frames": list(self.frames)}


def ranges(numbers: Iterable[int], most: int = 8) -> str:
    """Frame numbers for a sentence: "3, 7-9, …"; at most `most` runs are written out."""
    runs: list[list[int]] = []
    for n in sorted(set(numbers)):
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    shown = [str(a) if a == b else f"{a}-{b}" for a, b in runs[:most]]
    return ", ".join([*shown, "…"] if len(runs) > most else shown)
