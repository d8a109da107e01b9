"""The one place where the commands turn failures into a message and an exit code.

2 is a mistake that the user can mend, 130 and 143 are Ctrl-C and SIGTERM. Mistakes in hoigs keep
their traceback, and so does everything with -v or under HOIGS_TRACEBACK=1.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

from typer.core import TyperGroup

from hoigs.cli.common import Talk
from hoigs.core.errors import HoigsError, Interrupted
from hoigs.core.system.files import printable

# what a user does about the error of a system call
ADVICE = {
    errno.ENOSPC: "the disk is full; make room, or write to another disk",
    errno.EDQUOT: "the disk quota is used up; make room, or write to another disk",
    errno.EROFS: "this disk can only be read; write to another one",
    errno.EACCES: "this user may not; change the permissions, or name another place",
    errno.EPERM: "this user may not; change the permissions, or name another place",
    errno.ENOENT: "no such file or folder, and none can be made there",
    errno.ENOTDIR: "a part of this path is a file, not a folder",
    errno.EEXIST: "there is something of this name already",
    errno.EISDIR: "this is a folder, expected a file",
    errno.ENAMETOOLONG: "the name is too long for this disk",
    errno.EMFILE: "too many open files; raise the limit with `ulimit -n`",
    errno.ELOOP: "symbolic links that point at each other",
}
TOO_LARGE = (
    "there is not enough memory; reduce what is held at once (--set train.width=320, "
    "--set model.human.points=5000, a shorter clip), or stop other programs"
)
_stops: list[Interrupted] = []  # that were raised, and have not ended the command yet
ALLOCATORS = ("DefaultCPUAllocator", "out of memory", "Failed to allocate", "Storage size calc")


class GuardedGroup(TyperGroup):
    """Commands whose failures are messages; typer itself would name some of them wrongly."""

    def invoke(self, ctx: Any) -> Any:
        with failures_as_messages():
            return super().invoke(ctx)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, words = super().resolve_command(ctx, args)
        refuse_empty(command, words)
        return name, command, words


def refuse_empty(command: Any, words: Sequence[str]) -> None:
    """Raise HoigsError where a word of the command line is empty, as `"$CLIP"` is without a CLIP:
    as a path it would be the current folder."""
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    for before, word in zip(["", *words], words):
        option, equals, value = word.partition("=")
        if word == "":
            named = [(p.metavar or p.name).upper().strip("[]") for p in arguments]
            who = before if before.startswith("--") else " or ".join(named or ["an argument"])
        elif option.startswith("--") and equals and not value:
            who = option
        else:
            continue
        raise HoigsError(f"{who} is an empty text; give it a value, or leave it out")


@contextmanager
def failures_as_messages() -> Iterator[None]:
    """Turn failures of the block into a message on stderr and SystemExit."""
    before = _raise_stops()
    try:
        yield
    except KeyboardInterrupt as stop:
        _end(stop)
    except SystemExit as leaving:
        if _stops and leaving.code == 128 + signal.SIGINT:  # typer's, without a word
            _end(_stops[0])
        raise
    except Exception as error:
        stop_within = _stop_within(error)
        if stop_within is not None:
            _end(stop_within)
        message = message_of(error)
        wanted = Talk.verbose or os.environ.get("HOIGS_TRACEBACK", "0") not in ("", "0")
        if message is None or wanted:
            raise
        print(f"error: {printable(message)}", file=sys.stderr)
        sys.exit(2)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(stop: KeyboardInterrupt) -> NoReturn:
    _stops.clear()
    print(str(stop) or "stopped", file=sys.stderr)
    sys.exit(stop.code if isinstance(stop, Interrupted) else 128 + signal.SIGINT)


def _stop_within(error: BaseException) -> KeyboardInterrupt | None:
    """The Ctrl-C or SIGTERM that caused an error.

    It is in the error's chain where an extension's import was stopped; compiled code that reads a
    file raises an error of its own, and keeps nothing of the stop.
    """
    found: BaseException | None = error
    while found is not None and not isinstance(found, KeyboardInterrupt):
        found = found.__cause__ or found.__context__
    return found or (_stops[0] if _stops else None)


def message_of(error: Exception) -> str | None:
    """The message of a failure that a user can mend; None of a mistake in hoigs."""
    if isinstance(error, HoigsError):
        return str(error)
    # torch has no class of its own for it on a CPU
    allocated = isinstance(error, RuntimeError) and any(word in str(error) for word in ALLOCATORS)
    if isinstance(error, MemoryError) or allocated:
        return f"{TOO_LARGE} ({_first_line(error)})"
    if type(error).__name__ == "DecompressionBombError":  # Pillow's, which is not imported here
        return f"an image is too large to be opened safely: {_first_line(error)}"
    if isinstance(error, OSError) and error.errno not in (None, errno.EPIPE):
        return _of_system(error)
    return None


def _of_system(error: OSError) -> str:
    number = error.errno or 0
    reason = ADVICE.get(number, error.strerror or os.strerror(number))
    places = [os.fsdecode(p) if isinstance(p, bytes) else str(p)
              for p in (error.filename, error.filename2) if p is not None]  # fmt: skip
    return f"{' -> '.join(places) or 'a file'}: {reason} ({os.strerror(number)})"


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def _raise_stops() -> dict[signal.Signals, Any]:
    """Let SIGTERM end the command as Ctrl-C does, so that temporary files are removed, and keep
    either in `_stops`.

    Returns:
        the handlers before, of signals whose handler was replaced: whoever has set one keeps it.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {n: handler for n, handler in usual.items() if signal.getsignal(n) is handler}
    if before:
        _stops.clear()
    for number in before:
        signal.signal(number, _stop)
    return before


def _stop(number: int, _: FrameType | None) -> NoReturn:
    stop = Interrupted("stopped", number)
    _stops.append(stop)
    raise stop
