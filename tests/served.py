"""A viewer that runs in a thread, and a visitor that speaks to it as a browser does."""

from __future__ import annotations

import faulthandler
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from browser import in_thread

import hoigs
from hoigs.viewing.viewer.viewer import Viewer, Visit

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 1.0, 3.0),
    "look_at": (0.0, 1.0, 0.0), "up_direction": (0.0, 1.0, 0.0), "fov": 0.7, "near": 0.01,
    "far": 100.0, "image_height": 96, "image_width": 128,
}  # fmt: skip

WAITS = 60.0  # seconds for a picture, on a busy machine


@contextmanager
def served(*what: Path, **options: Any) -> Iterator[tuple[Viewer, str, list[str]]]:
    """The viewer, its address, and the lines that it reports."""
    lines: list[str] = []

    def serve(started: Callable[[Viewer], None]) -> None:
        hoigs.view(*what, port=0, device="cpu", report=lines.append, started=started, **options)

    with in_thread(serve, Viewer.stop) as viewer:
        address = next(line.split()[1] for line in lines if line.startswith("open http"))
        yield viewer, address, lines


class Visitor:
    """One websocket, opened as viser's page opens it; `origin` is the page's."""

    def __init__(self, address: str, origin: str | None = None) -> None:
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Origin, Subprotocol

        self.pictures = 0
        self.socket = connect(
            f"ws://{urlsplit(address).netloc}", origin=Origin(origin or address), proxy=None,
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None,
            compression=None,
        )  # fmt: skip

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, **message: Any) -> None:
        import msgspec

        self.socket.send(msgspec.msgpack.encode(message))

    def press(self, viewer: Viewer, label: str, value: Any = True) -> None:
        """Set the value of a control."""
        self.send(type="GuiUpdateMessage", uuid=uuid_of(viewer, label), updates={"value": value})

    def gets_a_picture(self, seconds: float = WAITS, **camera: Any) -> bool:
        """Whether one comes for a camera, which is sent until then, as by a hand at the mouse."""
        before, end = self.pictures, time.monotonic() + seconds
        while self.pictures == before and time.monotonic() < end:
            self.send(**CAMERA | camera)
            self.listen(1)
        if self.pictures == before and seconds >= WAITS:
            faulthandler.dump_traceback(all_threads=True)  # what the viewer waits for
        return self.pictures > before

    def listen(self, seconds: float) -> None:
        """Take one message, if it comes."""
        with suppress(TimeoutError):
            self.pictures += b"\xff\xd8\xff" in self.socket.recv(seconds, decode=False)


def controls(viewer: Viewer) -> dict[str, Any]:
    """viser's handles of the controls in the first visitor's panel, by id."""
    return dict(visit_of(viewer).eye.client.gui._gui_input_handle_from_uuid)


def visit_of(viewer: Viewer, seconds: float = 60) -> Visit:
    """The first visitor, once there is one."""
    end = time.monotonic() + seconds
    while not viewer.visits and time.monotonic() < end:
        time.sleep(0.05)
    return next(iter(viewer.visits.values()))


def uuid_of(viewer: Viewer, label: str) -> str:
    return next(u for u, c in controls(viewer).items() if getattr(c, "label", None) == label)
