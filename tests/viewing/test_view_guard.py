"""hoigs view: who is let in, what they may send, and that nobody stands in another's way."""

from __future__ import annotations

import io
import random
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from served import CAMERA, Visitor, controls, served, uuid_of, visit_of

from hoigs.core.errors import HoigsError
from hoigs.viewing.viewer.access import Door
from hoigs.viewing.viewer.server import open_server
from hoigs.viewing.viewer.takes import AHEAD, FILM_FPS, Film
from hoigs.viewing.viewer.takes import Path as TakenPath
from hoigs.viewing.viewer.viewer import Viewer
from hoigs.viewing.viewer.views import View

pytest.importorskip("viser", reason="viser is not installed: pip install 'hoigs[view]'")
pytestmark = pytest.mark.usefixtures("one_thread")

NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def running(tiny_run: Path) -> Iterator[tuple[Viewer, str]]:
    with served(tiny_run) as (viewer, address, _):
        yield viewer, address


@pytest.mark.parametrize(
    "host, asked, origin, good",
    [
        ("127.0.0.1", "127.0.0.1:8090", None, True),  # no browser, or a page that is opened
        ("127.0.0.1", "127.0.0.1:8090", "http://127.0.0.1:8090", True),
        ("127.0.0.1", "localhost:9000", "http://localhost:9000", True),  # through a tunnel
        ("127.0.0.1", "[::1]:8090", "http://[::1]:8090", True),
        ("127.0.0.1", "127.0.0.1:8090", "http://localhost:8090", False),
        ("127.0.0.1", "127.0.0.1:8090", "http://127.0.0.1:3000", False),  # another server's page
        ("127.0.0.1", "127.0.0.1:8090", "https://evil.example", False),
        ("127.0.0.1", "127.0.0.1:8090", "null", False),  # of a file, or of a sandbox
        ("127.0.0.1", "evil.example:8090", "http://evil.example:8090", False),  # a rebound name
        ("127.0.0.1", "127.0.0.1.evil.example", None, False),
        ("127.0.0.1", "192.168.0.7:8090", None, False),
        ("127.0.0.1", "0.0.0.0:8090", None, False),  # by which some browsers reach loopback
        ("127.0.0.1", "127.0.0.1:8090@evil.example", None, False),
        ("127.0.0.1", "", None, False),
        ("0.0.0.0", "192.168.0.7:8090", "http://192.168.0.7:8090", True),
        ("0.0.0.0", "evil.example:8090", "http://evil.example:8090", False),
        ("lab.example", "Lab.Example:8090", "http://Lab.Example:8090", True),
        ("lab.example", "evil.example:8090", None, False),
    ],
)
def test_only_our_own_names_and_pages_are_let_in(
    host: str, asked: str, origin: str | None, good: bool
) -> None:
    assert Door(host).admits([asked], [] if origin is None else [origin]) is good
    assert not Door(host).admits([asked, "127.0.0.1"], [])


def answer(address: str, path: str = "/", **headers: str) -> tuple[int, dict[str, str]]:
    class Stay(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, *_: Any) -> None:
            return None

    request = urllib.request.Request(address + path, headers=headers)
    try:
        with urllib.request.build_opener(Stay).open(request, timeout=30) as page:
            return page.status, dict(page.headers)
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers)


def test_strangers_get_neither_page_nor_pictures(running: tuple[Viewer, str]) -> None:
    from websockets.exceptions import InvalidStatus

    _, address = running
    status, headers = answer(address)
    assert status == 200
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert f"ws://{urlsplit(address).netloc}" in headers["Content-Security-Policy"]
    assert answer(address, Host="evil.example")[0] == 403
    assert answer(address, Origin="https://evil.example")[0] == 403
    # viser's page would obey another server, or a file, that its own address names
    for order in ("?websocket=ws://evil.example", "?playbackPath=https://evil.example/x"):
        status, headers = answer(address, "/" + order)
        assert status == 303 and headers["Location"] == "/"
    with pytest.raises(InvalidStatus, match="403"):
        Visitor(address, origin="https://evil.example")
    with Visitor(address) as visitor:
        assert visitor.gets_a_picture()


def test_a_viser_that_cannot_be_guarded_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    import viser.infra._infra as viser_server
    from websockets.asyncio import server as known

    # as of a version that does not look for `serve` where it is now
    own = SimpleNamespace(serve=known.serve, ServerConnection=known.ServerConnection)
    names = vars(viser_server.websockets) | {"asyncio": SimpleNamespace(server=own)}
    monkeypatch.setattr(viser_server, "websockets", SimpleNamespace(**names))
    with pytest.raises(HoigsError, match="could not be kept out"):
        open_server("127.0.0.1", 0, "test")


def read(message: dict[str, Any], control: Any = None) -> Any:
    import msgspec

    from hoigs.viewing.viewer.messages import checked

    got = checked(msgspec.msgpack.encode(message), lambda _: control)
    return None if got is None else msgspec.msgpack.decode(got)


def test_cameras_come_out_finite_and_bounded() -> None:
    for wrong in (
        {"wxyz": (NAN,) * 4}, {"wxyz": (0.0,) * 4}, {"wxyz": (1.0, 0.0)}, {"position": (0, 1, INF)},
        {"position": "abc"}, {"position": (0.0, 1.0, 0.0)}, {"look_at": (1e9, 0, 0)}, {"fov": NAN},
        {"up_direction": (0, 0, 0)}, {"image_width": "9"}, {"far": None},
        {"type": "ShareUrlRequest"},
    ):  # fmt: skip
        assert read(CAMERA | wrong) is None, wrong
    assert read(CAMERA)["position"] == [0.0, 1.0, 3.0]
    assert read(CAMERA | {"wxyz": (0, 2, 0, 0)})["wxyz"] == [0, 1, 0, 0]
    assert read(CAMERA | {"extra": [1] * 100}) == read(CAMERA)
    narrow, wide = read(CAMERA | {"fov": 0.0}), read(CAMERA | {"fov": 7.0})
    assert 0 < narrow["fov"] < 0.1 and 2 < wide["fov"] < np.pi
    huge = read(CAMERA | {"image_width": 2_000_000_000, "image_height": 1_000_000_000})
    assert (huge["image_width"], huge["image_height"]) == (4096, 2048)
    none = read(CAMERA | {"image_width": 0, "image_height": -5})
    assert min(none["image_width"], none["image_height"]) >= 16


def test_controls_get_only_what_they_offer(running: tuple[Viewer, str]) -> None:
    viewer, address = running
    with Visitor(address) as visitor:
        assert visitor.gets_a_picture()
        bounds_are_kept(viewer)


def bounds_are_kept(viewer: Viewer) -> None:
    def put(label: str, value: Any) -> Any:
        handle = controls(viewer)[uuid_of(viewer, label)]
        got = read({"type": "GuiUpdateMessage", "uuid": "", "updates": {"value": value}}, handle)
        return None if got is None else got["updates"]["value"]

    for uuid, handle in controls(viewer).items():  # each kind of control has a rule
        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": handle.value}}
        assert read(message, handle)["updates"]["value"] is not None, handle
    last = viewer.clip.num_frames - 1
    assert [put("Frame", v) for v in (1, -3, 1e9, NAN, INF, "abc", True)] == [
        1, 0, last, None, None, None, None,
    ]  # fmt: skip
    assert put("Speed", 1e300) is None and put("Speed", 1e17) == 4.0
    assert put("Seconds of film", 1e9) == 20.0
    assert put("Orbit about", "nobody") is None and put("Orbit about", "human") == "human"
    assert put("Loop", 1.0) is None and put("Loop", False) is False
    assert put("Background", (300, -5, 7.2)) == [255, 0, 7] and put("Background", (1, 2)) is None
    other = {"type": "GuiUpdateMessage", "uuid": "", "updates": {"label": "x", "value": True}}
    loop = controls(viewer)[uuid_of(viewer, "Loop")]
    assert read(other, loop)["updates"] == {"value": True}
    assert read(other, None) is None


def test_500_mutated_messages_leave_the_viewer_to_others(tiny_run: Path) -> None:
    import msgspec
    from websockets.exceptions import ConnectionClosed

    chance = random.Random(7)
    odd: list[Any] = [
        NAN, INF, -INF, 0, -1, 1e308, 2**63, "", "abc", "x" * 5000, True, None, [], [NAN] * 4,
        [[]] * 50, {"a": {}}, b"\xff" * 40,
    ]  # fmt: skip

    def mutated(viewer: Viewer) -> bytes | str:
        uuid, handle = chance.choice(list(controls(viewer).items()))
        update = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": handle.value}}
        message: dict[Any, Any] = dict(chance.choice((CAMERA, CAMERA, update)))
        key = chance.choice(list(message))
        match chance.randrange(6):
            case 0:
                del message[key]
            case 1:
                message[key] = chance.choice(odd)
            case 2 if message["type"] == "GuiUpdateMessage":
                message["updates"] = {chance.choice(("value", "label")): chance.choice(odd)}
            case 2:
                vector = list(message["position"])
                vector[chance.randrange(3)] = chance.choice(odd)
                message["position"] = vector
            case 3:
                message["type"] = chance.choice(
                    ("ShareUrlRequest", "RunJavascriptMessage", "FileTransferStartUpload", "", None)
                )
            case 4:
                raw = bytearray(msgspec.msgpack.encode(message))
                for _ in range(chance.randint(1, 4)):
                    raw[chance.randrange(len(raw))] = chance.randrange(256)
                return bytes(raw[: chance.randint(0, len(raw))] if chance.random() < 0.3 else raw)
            case 5:
                return chance.choice(("text", b"", b"\x91" * 50_000, b"\xdf\xff\xff\xff\xff"))
        return msgspec.msgpack.encode(message)

    began = time.monotonic()
    with served(tiny_run, width=128) as (viewer, address, _):
        visitor = Visitor(address)
        assert visitor.gets_a_picture()
        for _ in range(500):
            try:
                visitor.socket.send(mutated(viewer))
            except ConnectionClosed:  # as it may be: it comes again
                visitor = Visitor(address)
        assert visitor.socket.ping().wait(60)  # all but the last few have been taken
        with Visitor(address) as other:
            assert other.gets_a_picture(position=(0.4, 1.0, 3.0))
        for handle in controls(viewer).values():
            assert np.isfinite(handle.value).all() if isinstance(handle.value, float) else True
        assert visit_of(viewer).settings.follow in (None, *viewer.drawings[0].names)
        visitor.socket.close()
    assert time.monotonic() - began < 240


def test_what_fails_for_one_browser_ends_nothing(
    running: tuple[Viewer, str], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    viewer, address = running
    draw = viewer.picture

    def fragile(size: tuple[int, int], *rest: Any) -> Any:
        if size[0] == size[1]:
            raise RuntimeError("square")
        return draw(size, *rest)

    monkeypatch.setattr(viewer, "picture", fragile)
    with Visitor(address) as failing, Visitor(address) as other:
        assert not failing.gets_a_picture(3, image_width=96)
        assert other.gets_a_picture(position=(0.2, 1.0, 3.0))
        failing.press(viewer, "Screenshot")
        assert other.gets_a_picture(position=(0.3, 1.0, 3.0))
        assert failing.gets_a_picture()  # once it can be drawn
    assert 1 <= capfd.readouterr().err.count("RuntimeError: square") <= 2


def test_a_film_does_not_keep_others_waiting(running: tuple[Viewer, str]) -> None:
    viewer, address = running
    with Visitor(address) as maker, Visitor(address) as other:
        assert maker.gets_a_picture() and other.gets_a_picture()
        for x in (0.5, 1.0):
            assert maker.gets_a_picture(position=(x, 1.0, 3.0))
            count = len(visit_of(viewer).path.keys)
            maker.press(viewer, "Add this view to the path")
            until(lambda n=count: len(visit_of(viewer).path.keys) > n)
        maker.press(viewer, "Seconds of film", 1e9)
        maker.press(viewer, "Film the path (mp4)")
        until(lambda: visit_of(viewer).film is not None)
        film = visit_of(viewer).film
        assert film is not None
        assert film.count == 20 * FILM_FPS
        assert other.gets_a_picture(position=(0.1, 1.0, 3.0))
        assert film.drawn < film.count
    until(film._made.done)  # who goes takes the film along


def test_a_film_is_drawn_a_picture_at_a_time() -> None:
    import av

    view = View(np.zeros(3), np.ones(3), np.eye(3), np.eye(3)[1], 0.8)
    path = TakenPath([(0.0, view), (6.0, view)])
    frames: list[float] = []

    def draw(frame: float, _: View) -> np.ndarray:
        frames.append(frame)
        return np.zeros((16, 16, 3), np.uint8)

    film, done = Film(path, 0.5, draw), None
    path.keys.clear()  # which the film no longer needs
    while done is None:
        before = film.drawn
        done = film.step()
        assert film.drawn <= before + 1 and len(frames) == film.drawn
        assert film._frames.qsize() <= AHEAD + 1
    assert frames == pytest.approx(np.linspace(0, 6, 15))
    with av.open(io.BytesIO(done)) as video:
        assert sum(1 for _ in video.decode(video=0)) == film.count == 15


def until(check: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end
        time.sleep(0.05)
