"""Progress: how long work reports how far it is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]  # the share that is done, in [0, 1], and the present work


def no_progress(done: float, text: str) -> None:
    """A Progress that reports nothing."""
