"""What long work reports: Diagnostic, one thing found out about a clip, and Progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from html import escape
from importlib import import_module
from typing import Any, Literal

Severity = Literal["good", "fair", "bad"]


@dataclass(frozen=True)
class Diagnostic:
    """What was found and what to do about it.

    Attributes:
        kind: a short name for tests and tables: "empty-masks", "depth-scale" …
        what: what was found, where and how much of it.
        do: what a user can do, and what training does meanwhile; "" where nothing is to be done.
        frames: the frames that have it; () where it concerns the whole clip.
        severity: "good" needs nothing, "fair" makes results worse, "bad" makes them useless.
    """

    kind: str
    what: str
    do: str = ""
    frames: tuple[int, ...] = ()
    severity: Severity = "fair"

    def __str__(self) -> str:
        return f"{self.what}: {self.do}"

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in a run's provenance.json."""
        return {"kind": self.kind, "what": self.what, "do": self.do, "frames": list(self.frames)}


def ranges(numbers: Iterable[int], most: int = 8, digits: int = 1) -> str:
    """Frame numbers for a sentence: "3, 7-9, …".

    Args:
        most: ranges that are written out. digits: smallest number of digits: "00003, 00007-00009".
    """
    runs: list[list[int]] = []
    for n in sorted(set(numbers)):
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    shown = [
        f"{a:0{digits}d}" if a == b else f"{a:0{digits}d}-{b:0{digits}d}" for a, b in runs[:most]
    ]
    return ", ".join([*shown, "…"] if len(runs) > most else shown)


# Progress: how long work reports how far it is.

Progress = Callable[[float, str], None]  # the share that is done, in [0, 1], and the present work


def no_progress(done: float, text: str) -> None:
    """A Progress that reports nothing."""


EVERY_S = 0.2  # between two pictures of a bar


class NotebookBar:
    """A Progress as a bar below the cell of a notebook, which needs no widgets."""

    def __init__(self) -> None:
        self._shown = import_module("IPython.display").display(
            {"text/plain": ""}, raw=True, display_id=True
        )
        self._last = 0.0

    def __call__(self, done: float, text: str) -> None:
        now = time.monotonic()
        if done < 1 and now - self._last < EVERY_S:
            return
        self._last = now
        bar = f"<progress max=1 value={done:.3f}></progress> {100 * done:.0f} % {escape(text)}"
        self._shown.update({"text/html": bar, "text/plain": f"{100 * done:.0f} % {text}"}, raw=True)


def in_notebook() -> bool:
    """Whether this is the kernel of a notebook; a program without IPython does not import it."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


def default_progress() -> Progress:
    """What a verb reports to if its caller named nothing: a bar in a notebook, else nothing."""
    return NotebookBar() if in_notebook() else no_progress
