"""Watching the import of a plugin's module: its duration, output and threads."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from types import FrameType

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
    """Keep what is printed, and make the threads that this thread starts daemons.

    A listing on stdout may be JSON, so imports must not write there. A thread that never ends
    would keep the command from ending. Threads that those threads start are daemons too.
    """
    seen, caught = Watched(), io.StringIO()
    loaded = set(HEAVY) & set(sys.modules)
    here, start = threading.current_thread(), threading.Thread.start

    def start_as_daemon(thread: threading.Thread) -> None:
        if threading.current_thread() is here:
            thread.daemon = True
            seen.threads.append(thread.name)
        start(thread)

    threading.Thread.start = start_as_daemon  # type: ignore[method-assign, assignment]
    began = time.perf_counter()
    try:
        with redirect_stdout(caught), redirect_stderr(caught):
            yield seen
    finally:
        seen.seconds = time.perf_counter() - began
        threading.Thread.start = start  # type: ignore[method-assign]
        seen.printed = caught.getvalue()
        seen.heavy = [name for name in HEAVY if name in sys.modules and name not in loaded]


class TooLong(BaseException):
    """An import that did not end in time; no plugin that catches Exception can go on with it."""


@contextmanager
def stops_raised_again() -> Iterator[None]:
    """Raise Ctrl-C and SIGTERM again that the block caught, or turned into another exception.

    A plugin with a bare `except:` around an import would go on, or be called broken.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    stops: list[KeyboardInterrupt] = []

    def keep(number: int, frame: FrameType | None) -> None:
        handler = before[signal.Signals(number)]
        assert callable(handler)
        try:
            handler(number, frame)
        except KeyboardInterrupt as stop:
            stops.append(stop)
            raise

    for number, handler in before.items():
        if callable(handler):
            signal.signal(number, keep)
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is keep:
                signal.signal(number, handler)
        if stops:
            raise stops[0]


@contextmanager
def limited(what: str, block: str | None) -> Iterator[None]:
    """Raise TooLong in an import that does not end, and name it on stderr before that.

    Python can end what waits or loops in the main thread. Elsewhere, and in compiled code that
    does not return, `what` is named, and the rest is left to the user. $HOIGS_IMPORT_TIMEOUT says
    after how many seconds; else 60.

    Args:
        what: is imported. block: the value of HOIGS_BLOCK that leaves it out, if one does.
    """
    seconds = _timeout()
    advice = f"HOIGS_BLOCK={block} leaves it out, " if block else ""
    advice += "HOIGS_IMPORT_TIMEOUT=SECONDS waits longer"

    def name_it() -> None:
        print(f"hoigs: still waiting for {what}; {advice}", file=sys.__stderr__, flush=True)

    def stop(*_: object) -> None:
        raise TooLong(f"its import did not end in {seconds:g} s; {advice}")

    notice = threading.Timer(seconds / 4, name_it)
    notice.daemon = True
    main = threading.current_thread() is threading.main_thread()
    alarm = main and hasattr(signal, "setitimer") and signal.getitimer(signal.ITIMER_REAL)[0] == 0
    before = signal.signal(signal.SIGALRM, stop) if alarm else None
    notice.start()
    if alarm:
        signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        with stops_raised_again():
            yield
    finally:
        notice.cancel()
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)


def _timeout() -> float:
    try:
        return max(0.1, float(os.environ.get("HOIGS_IMPORT_TIMEOUT", "60")))
    except ValueError:
        return 60.0


def traceback_tail(error: BaseException) -> str:
    """The innermost frames of an exception, and its message."""
    return "".join(traceback.format_exception(error, limit=-TAIL)).rstrip()
