"""Who may look at the viewer: its own page, opened by an address of this machine.

Any page in a browser can open a websocket to a server of the same machine, and the name of a page
can be rebound to this machine's address. viser checks neither, so it is done here: the request
must name a host that is ours (`Host`), and come from the page of that very host (`Origin`).
"""

from __future__ import annotations

import ipaddress
import re
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the rest of hoigs does without
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    Answer = Callable[[ServerConnection, Request], Response | None]

_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:\d{1,5})?", re.IGNORECASE)
_starting = threading.Lock()


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server bound to `host`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Door:
    """Lets requests and messages in, or not.

    Args:
        host: the address that the server listens on.

    Attributes:
        closed: whether a server is behind it.
        control: viser's handle of a control's id, or None; messages to others are left out.
    """

    def __init__(self, host: str) -> None:
        self.host, self.closed = host.lower(), False
        self.control: Callable[[str], Any] = lambda uuid: None

    def admits(self, hosts: Sequence[str], origins: Sequence[str]) -> bool:
        """Whether a request with these headers is ours; programs other than browsers send no
        `Origin`.

        The port is not compared: through a tunnel it is another one, and the origin has it too.
        """
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return False
        return set(origins) <= {f"http://{hosts[0]}", f"https://{hosts[0]}"}

    def _is_ours(self, host: str) -> bool:
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = match["name"].strip("[]").lower()
        if is_loopback(name) or name == self.host:
            return True
        if is_loopback(self.host):
            return False
        try:  # an address in digits cannot be rebound
            return bool(ipaddress.ip_address(name))
        except ValueError:
            own = socket.gethostname().lower()
            return name in (own, f"{own}.local")

    def before(self, answer: Answer) -> Answer:
        """Answers a request, after the check."""

        def check(connection: ServerConnection, request: Request) -> Response | None:
            hosts = request.headers.get_all("Host")
            if not self.admits(hosts, request.headers.get_all("Origin")):
                return connection.respond(
                    HTTPStatus.FORBIDDEN,
                    "Open the address that was printed. Another name of this machine is let in "
                    "where `--host` gives it.\n",
                )
            path, query, _ = request.path.partition("?")
            response = answer(connection, request)
            if response is None:
                return None
            if query:  # by which viser's page takes orders, and code, from any other server
                response = connection.respond(HTTPStatus.SEE_OTHER, "")
                response.headers["Location"] = "/" if path.startswith("//") else path
            host = hosts[0]
            response.headers["Content-Security-Policy"] = (
                f"connect-src 'self' ws://{host} wss://{host} data: blob:; frame-ancestors 'none'; "
                "base-uri 'none'; form-action 'none'; object-src 'none'"
            )
            response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
            response.headers["Referrer-Policy"] = "no-referrer"
            response.headers["X-Content-Type-Options"] = "nosniff"
            return response

        return check

    def connection(self) -> type[ServerConnection]:
        """Connections that pass checked messages on."""
        from websockets.asyncio.server import ServerConnection

        from hoigs.viewing.viewer.messages import checked

        door = self

        class Checked(ServerConnection):
            async def recv(self, *args: Any, **options: Any) -> Any:
                while True:
                    message = checked(await super().recv(*args, **options), door.control)
                    if message is not None:
                        return message

        return Checked


@contextmanager
def guarded(door: Door) -> Iterator[None]:
    """A viser server that is made in this context is behind the door.

    viser has no place for checks, and starts its server by `websockets.asyncio.server.serve`: that
    name is ours for the moment. Whoever made the server must look at `door.closed`.
    """

    from websockets.asyncio import server as websockets

    from hoigs.viewing.viewer.messages import LARGEST

    def serve(handler: Any, *args: Any, **options: Any) -> Any:
        if not str(handler.__module__).startswith("viser."):  # of another thread
            return original(handler, *args, **options)
        options["process_request"] = door.before(options["process_request"])
        options["max_size"] = LARGEST
        door.closed = True
        return original(handler, *args, create_connection=door.connection(), **options)

    with _starting:
        original = websockets.serve
        try:
            websockets.serve = serve  # type: ignore[assignment, misc]
            yield
        finally:
            websockets.serve = original  # type: ignore[misc]
