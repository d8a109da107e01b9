"""LiveView: `hoigs view` of a run in training, in a process that ends with the training's."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from hoigs.core.machine.python import PYTHON
from hoigs.viewing.viewer.server import free_port, require_viser

NICENESS = 10  # where processors are short, training goes first


class LiveView:
    """A viewer in its own process, so that drawing never holds the training's interpreter.

    The process ends when its standard input does: on leaving the context, and also when the
    training is killed. It is in a session of its own, since Ctrl-C is the training's to answer.

    Args:
        port: 0 finds a free one. device, rasterizer, plugins: as for `hoigs.view`.

    Attributes:
        port: of its address on this machine.

    Raises:
        HoigsError: viser is not installed, or the port is in use.
    """

    def __init__(
        self,
        port: int,
        *,
        device: str = "auto",
        rasterizer: str | None = None,
        plugins: Sequence[Path | str] = (),
    ) -> None:
        require_viser()
        self.port = free_port(port)
        self._options = [device, rasterizer or "", *map(str, plugins)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, run: Path) -> None:
        """Show a run, once it has a checkpoint."""
        self._process = subprocess.Popen(
            [*PYTHON, "-m", __name__, str(run), str(self.port), *self._options],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._process is None:
            return
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _end_with_input() -> None:
    """End this process when its standard input does; a viewer has nothing to put in order."""
    sys.stdin.buffer.read()
    os._exit(0)


def main(arguments: Sequence[str]) -> None:
    """The process of the viewer: RUN PORT DEVICE RASTERIZER [PLUGIN …]."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    from hoigs.viewing.view import view

    run, port, device, rasterizer, *plugins = arguments
    view(
        run, port=int(port), device=device, rasterizer=rasterizer or None, plugins=plugins,
        report=lambda line: None,
    )  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
