"""The web server: viser on loopback, with errors that speak."""

from __future__ import annotations

import contextlib
import io
import socket
from importlib.util import find_spec
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.viewing.viewer.access import Door, guarded

LOCAL = "127.0.0.1"


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

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """No public tunnel: a browser may request one, which would end loopback."""
            return None

    _require_free(host, port)
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

    def control(uuid: str) -> Any:
        for gui in (server.gui, *(client.gui for client in server.get_clients().values())):
            for handles in (gui._gui_input_handle_from_uuid, gui._command_handle_from_uuid):
                if uuid in handles:
                    return handles[uuid]
        return None

    door.control = control
    if port not in (0, server.get_port()):  # taken in between: viser goes on to the next
        stop(server)
        raise HoigsError(_in_use(port))
    server.gui.configure_theme(
        dark_mode=True, show_share_button=False, show_logo=False, control_width="medium",
        brand_color=(242, 158, 66),
    )  # fmt: skip
    server.gui.main_panel.dock_right()  # beside the picture, not over it
    return server


def require_viser() -> None:
    """Raise HoigsError if viser is not installed."""
    if find_spec("viser") is None:
        raise HoigsError("the viewer needs viser: pip install 'hoigs[view]'")


def free_port(port: int) -> int:
    """This port, or for 0 any free one, of this machine's loopback address.

    Raises:
        HoigsError: the port is in use, or there is none of this number.
    """
    _require_free(LOCAL, port)
    if port:
        return port
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


def stop(server: Any) -> None:
    """Stop a server without viser's line on stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _require_free(host: str, port: int) -> None:
    if not 0 <= port <= 65535:
        raise HoigsError(f"port {port}: expected 0 (any free one) to 65535")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except socket.gaierror as error:
            raise HoigsError(f"host {host!r}: {error.strerror}; expected an address") from error
        except PermissionError as error:
            raise HoigsError(f"port {port}: not allowed; ports below 1024 need root") from error
        except OSError as error:
            if error.errno == 98 or "in use" in str(error):
                raise HoigsError(_in_use(port)) from error
            raise HoigsError(
                f"host {host!r}: {error.strerror}; give an address of this machine, for example "
                f"{LOCAL}"
            ) from error


def _in_use(port: int) -> str:
    return f"port {port} is in use; give another, or --port 0 for any free one"
