"""view: a run or a clip in the browser, live or as one HTML file."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.options import verb
from hoigs.core.registry.registry import default_registry
from hoigs.core.reporting import Progress
from hoigs.core.system.environments import PYTHON
from hoigs.runs.clip_source import clip_folder, read_clip
from hoigs.runs.options import ModelOptions
from hoigs.viewing.options import ViewOptions
from hoigs.viewing.player.page import Page, write_page
from hoigs.viewing.viewer.access import is_loopback
from hoigs.viewing.viewer.clip_drawing import ClipDrawing
from hoigs.viewing.viewer.following import FollowedRun, wait_for_checkpoint
from hoigs.viewing.viewer.overlays import bodies_of_clip, bodies_of_run, offered
from hoigs.viewing.viewer.run_drawing import Drawing, RunDrawing
from hoigs.viewing.viewer.server import free_port, open_server, require_viser, stop
from hoigs.viewing.viewer.viewer import Viewer

Report = Callable[[str], None]
SERVED = ("host", "port", "width")  # options of a page that is served


@verb(ViewOptions)
def view(
    what: Path | str,
    second: Path | str | None = None,
    *,
    options: ViewOptions,
    report: Report = print,
    progress: Progress | None = None,
    started: Callable[[Viewer], None] | None = None,
) -> Page | None:
    """Show a run, two runs with one clock, or a clip in the browser, until interrupted.

    A run in training is read again after each checkpoint.

    Args:
        what: a run folder, a clip folder, or "builtin:NAME". second: another run.
        report: receives lines: the address, and warnings.
        progress: called with the share done of the file, in [0, 1], and the work.
        started: receives the viewer before it draws, for example to stop it from a thread.

    Returns:
        The page that was written with `html`; otherwise None.

    Raises:
        HoigsError: this is neither a run nor a clip, or the port is in use.
    """
    runs = [Path(p) for p in (what, second) if p is not None and is_run(p)]
    if second is not None and len(runs) < 2:
        odd = what if not is_run(what) else second
        raise HoigsError(f"{odd}: two can be shown together if both are run folders; this is none")
    if options.html is not None:
        if len(runs) != 1 or second is not None:
            raise HoigsError(f"--html writes one run, and {what} is none; `hoigs train` makes one")
        served = ViewOptions()
        if any(getattr(options, n) != getattr(served, n) for n in SERVED):
            raise HoigsError(
                f"{', '.join(SERVED)} are of a page that is served, and --html writes a file: "
                "leave them out"
            )
        return write_page(
            options.open(runs[0], pixels=False), options.html, max_mb=options.max_mb,
            entities=options.entities, progress=progress,
        )  # fmt: skip
    if options.max_mb is not None or options.entities:
        raise HoigsError("max_mb and entities are of the file that `html` names")
    registry = default_registry(plugin_files=options.plugins)
    followed = []
    for path in runs:
        wait_for_checkpoint(path, report)
        followed.append(FollowedRun(path, partial(options.open, path, pixels=False)))
    drawings: list[Drawing]
    if followed:
        drawings = [RunDrawing(run.loaded) for run in followed]
        bodies = bodies_of_run(followed[0].loaded.model, followed[0].loaded.clip)
    else:
        folder = clip_folder(what, registry)
        if not folder.exists():
            raise HoigsError(
                f"{folder}: no such folder; `hoigs train CLIP --out {folder}` makes a run, and "
                f"`hoigs prepare VIDEO --out {folder}` a clip"
            )
        source = read_clip(folder, registry, allow_faults=True)
        bodies, missing = bodies_of_clip(source, registry)
        for name, why in missing.items():
            report(f"{name}: {why}")
        drawings = [ClipDrawing(source)]
    overlays = offered(drawings[0].clip, bodies, before_training=not followed)
    host = options.host
    server = open_server(host, options.port, "hoigs")
    try:
        viewer = Viewer(
            server, drawings, bodies, overlays, widest=options.width,
            refresh=partial(_newer, followed, drawings, report),
        )  # fmt: skip
        if not is_loopback(host):
            report(
                f"warning: anybody who can reach {host} can look at this and use this machine's "
                "time; there is no password"
            )
        shown = f"[{host}]" if ":" in host else host
        report(f"open http://{shown}:{server.get_port()} (Ctrl-C ends it)")
        if started is not None:
            started(viewer)
        viewer.serve()
    except KeyboardInterrupt:
        report("stopped")
    finally:
        stop(server)
    return None


def is_run(what: Path | str) -> bool:
    """Whether a folder is a run, whole or not."""
    return any((Path(what) / name).exists() for name in ("spec.yaml", "checkpoints"))


def _newer(
    followed: Sequence[FollowedRun], drawings: list[Drawing], report: Report
) -> Sequence[Drawing] | None:
    """The drawings with those of newer checkpoints in their places; None if there are none."""
    changed = False
    for i, run in enumerate(followed):
        loaded = run.poll()
        if loaded is not None:
            drawings[i], changed = RunDrawing(loaded), True
            report(f"{run.path}: step {loaded.step}")
    return drawings if changed else None


# LiveView: `hoigs view` of a run in training, in a process that ends with the training's.

NICENESS = 10  # where processors are short, training goes first


class LiveView:
    """A viewer in its own process, so that drawing never holds the training's interpreter.

    The process ends when its standard input does: on leaving the context, and also when the
    training is killed. It is in a session of its own, since Ctrl-C is the training's to answer.

    Args:
        port: 0 finds a free one. options: how the run is opened.

    Attributes:
        port: of its address on this machine.

    Raises:
        HoigsError: viser is not installed, or the port is in use.
    """

    def __init__(self, port: int, options: ModelOptions) -> None:
        require_viser()
        self.port = free_port(port)
        self._options = [options.device, options.rasterizer or "", *map(str, options.plugins)]
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

    def __exit__(self, *error: object) -> None:
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

    run, port, device, rasterizer, *plugins = arguments
    view(
        run, port=int(port), device=device, rasterizer=rasterizer or None, plugins=plugins,
        report=lambda line: None,
    )  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
