"""The web server: viser on loopback, with errors that speak."""

from __future__ import annotations

import contextlib
import io
from importlib.util import find_spec
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.viewing.viewer.addresses import in_use, require_free


def open_server(host: str, port: int, label: str) -> Any:
    """A viser server, behind a door that keeps other pages and unfit messages out (`access`).

    Args:
        port: 0 finds a free one.

    Raises:
        HoigsError: viser is absent or cannot be guarded, the port is in use, or this machine has no
            such host.
    """
    require_viser()
    import viser

    from hoigs.viewing.viewer.access import Door, guarded

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """No public tunnel: a browser may request one, which would end loopback."""
            del verbose
            return None

    require_free(host, port)
    door = Door(host)
    # viser prints a box with other addresses
    with contextlib.redirect_stdout(io.StringIO()), guarded(door):
        server = Server(host=host, port=port, label=label, verbose=False)
    if not door.closed:
        stop(server)
        raise HoigsError(
            f"viser {viser.__version__} starts its server in a way that is not known here, so "
            "other pages could not be kept out: pip install viser==1.1.1"
        )
    door.control = server.gui._gui_input_handle_from_uuid.get
    if port not in (0, server.get_port()):  # taken in between: viser goes on to the next
        stop(server)
        raise HoigsError(in_use(port))
    server.gui.configure_theme(
        dark_mode=True, show_share_button=False, show_logo=False, control_width="medium",
        brand_color=(242, 158, 66),
    )  # fmt: skip
    server.gui.main_panel.dock_right()  # beside the picture, not over it
    return server


def require_viser() -> None:
    """Raise HoigsError if viser is not installed."""
    if find_spec("viser") is None:
        raise HoigsError("the viewer needs viser: pip install 'hoigs[viewer]'")


def stop(server: Any) -> None:
    """Stop a server without viser's line on stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
