"""annotate: click on people and objects of a video in a local page, and prepare it from there."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

from hoigs.annotation.server import PageServer
from hoigs.annotation.session import Session
from hoigs.core.names import name_from
from hoigs.preparation.options.option_files import load_options
from hoigs.preparation.options.prepare_options import PrepareOptions
from hoigs.preparation.video.source import find_source


def annotate(
    video: Path | str,
    out: Path | str | None = None,
    *,
    port: int = 8091,
    overrides: Sequence[str] = (),
    options: PrepareOptions | Path | str | None = None,
    open_browser: bool = False,
    report: Callable[[str], None] = print,
    started: Callable[[PageServer], None] | None = None,
) -> None:
    """Serve the page of one video on this machine's loopback address, until interrupted.

    What is clicked is stored beside the video (`prompt_file`), from where `prepare` reads it.

    Args:
        video: a video, or a folder with one or with frames.
        out: the clip that the page proposes; None: clips/ and the video's name.
        port: 0 finds a free one.
        overrides, options: of the preparations that the page starts, as for `prepare`.
        open_browser: open the page in the user's browser.
        report: receives lines: the address.
        started: receives the server before it serves, for example to shut it down from a thread.

    Raises:
        SourceError: this is no video. SpecError: options, or stored clicks, are wrong.
        HoigsError: the port is in use.
    """
    chosen = load_options(options, overrides)
    found = find_source(Path(video), complete=False).video
    given = Path("clips") / name_from(found.stem, "mine") if out is None else Path(out)
    session = Session(found, given, chosen)
    try:
        with PageServer(session, port) as server:
            report(f"open {server.address} (Ctrl-C ends it)")
            if started is not None:
                started(server)
            if open_browser:
                webbrowser.open(server.address)
            server.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        report("stopped")
    finally:
        session.close()
