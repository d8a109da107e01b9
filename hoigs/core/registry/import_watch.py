"""Watching the import of a plugin's module: its duration, output and threads."""

from __future__ import annotations

import io
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field

SLOW = 0.3  # seconds; a listing as a whole should stay below half a second
HEAVY = ("torch", "warp", "numpy", "scipy", "matplotlib")
TAIL = 4  # frames of a traceback that are kept: the innermost


@dataclass
class Watched:
    """What an import did.

    Attributes:
        seconds: wall time. printed: to stdout and stderr. threads: names of those that it started.
        heavy: packages that were not loaded before.
    """

    seconds: float = 0.0
    printed: str = ""
    threads: list[str] = field(default_factory=list)
    heavy: list[str] = field(default_factory=list)

    def remarks(self) -> list[str]:
        """One line for each side effect that its author should remove."""
        lines = []
        if self.seconds > SLOW:
            lines.append(f"slow: {self.seconds:.1f} s at every start of hoigs")
        if self.heavy:
            lines.append(f"imports {', '.join(self.heavy)} even for a listing")
        if self.printed:
            text = " ".join(self.printed.split())
            lines.append(f'prints while it is imported: "{text[:60]}{"…" * (len(text) > 60)}"')
        if self.threads:
            lines.append(f"starts threads while it is imported: {', '.join(self.threads)}")
        return lines


@contextmanager
def watched() -> Iterator[Watched]:
    """Keep what is printed: a listing on stdout may be JSON, so imports must not write there."""
    seen, caught = Watched(), io.StringIO()
    loaded, running = set(HEAVY) & set(sys.modules), set(threading.enumerate())
    began = time.perf_counter()
    try:
        with redirect_stdout(caught), redirect_stderr(caught):
            yield seen
    finally:
        seen.seconds = time.perf_counter() - began
        seen.printed = caught.getvalue()
        seen.threads = [t.name for t in threading.enumerate() if t not in running]
        seen.heavy = [name for name in HEAVY if name in sys.modules and name not in loaded]


def traceback_tail(error: BaseException) -> str:
    """The innermost frames of an exception, and its message."""
    return "".join(traceback.format_exception(error, limit=-TAIL)).rstrip()
