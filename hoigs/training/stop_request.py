"""StopRequest: Ctrl-C, SIGTERM and a closed terminal end a training after its present step."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import threading
from types import FrameType, TracebackType
from typing import Any

from hoigs.runs.run_folder import RunFolder

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
NOTICE = b"\nstopping after this step, with a checkpoint; once more to stop at once\n"


class StopRequest:
    """Inside, the first SIGINT, SIGTERM or SIGHUP is kept in `signal`; a second one acts as usual.

    Python handles signals in the main thread alone; in another one nothing changes.

    Attributes:
        signal: number of the signal that came, or None.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in SIGNALS}
            for number, before in self._before.items():
                if before is not signal.SIG_IGN:  # nohup, or a shell's background job
                    signal.signal(number, self._request)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._restore()

    def _request(self, number: int, _: FrameType | None) -> None:
        self.signal = number
        self._restore()
        with contextlib.suppress(OSError):  # the terminal may be gone
            os.write(2, NOTICE)  # print may be interrupted in the middle of its own buffer

    def _restore(self) -> None:
        for number, before in self._before.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)
        self._before = {}


def resume_command(run: RunFolder) -> str:
    """The command that continues the run in a folder."""
    return f"hoigs train --resume --out {shlex.quote(str(run.path))}"
