"""Hosts and ports on which pages are served."""

from __future__ import annotations

import ipaddress
import socket

from hoigs.core.errors import HoigsError

LOCAL = "127.0.0.1"


def free_port(port: int) -> int:
    """This port, or for 0 any free one, of this machine's loopback address.

    Raises:
        HoigsError: the port is in use, or there is none of this number.
    """
    require_free(LOCAL, port)
    if port:
        return port
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server bound to `host`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def require_free(host: str, port: int) -> None:
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
                raise HoigsError(in_use(port)) from error
            raise HoigsError(
                f"host {host!r}: {error.strerror}; give an address of this machine, for example "
                f"{LOCAL}"
            ) from error


def in_use(port: int) -> str:
    return f"port {port} is in use; give another, or --port 0 for any free one"
