"""The page's addresses, on loopback, for this page alone.

Any page in a browser can send requests to a server of the same machine. So every address begins
with a random token that only the printed address has, and requests that name another host (a
rebound name) or come from another page are refused.
"""

from __future__ import annotations

import json
import secrets
import traceback
import webbrowser
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from pydantic import ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.system.files import json_value
from hoigs.core.system.video_files import pyav
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.source import clip_named_after, find_source
from hoigs.viewing.annotate.session import Session

LOCAL = "127.0.0.1"
LARGEST = 4_000_000  # bytes of a request
REPORT = {".html": "text/html; charset=utf-8", ".mp4": "video/mp4", ".jpg": "image/jpeg"}
Answer = tuple[HTTPStatus, str, bytes, str]  # status, type, body, what is doubtful


class PageServer(ThreadingHTTPServer):
    """Serves one session.

    Args:
        port: 0 finds a free one.

    Raises:
        HoigsError: the port is in use.
    """

    daemon_threads = True

    def __init__(self, session: Session, port: int) -> None:
        self.session, self.token = session, secrets.token_urlsafe(24)
        try:
            super().__init__((LOCAL, port), _Handler)
        except (OSError, OverflowError) as error:
            raise HoigsError(
                f"port {port} cannot be used ({error}); give another, or --port 0 for a free one"
            ) from error
        self.nonce = secrets.token_urlsafe(12)
        page = files("hoigs.viewing.annotate").joinpath("page.html").read_text(encoding="utf-8")
        self.page = page.replace("NONCE", self.nonce).encode()

    @property
    def hosts(self) -> tuple[str, str]:
        return (f"{LOCAL}:{self.server_port}", f"localhost:{self.server_port}")

    @property
    def address(self) -> str:
        return f"http://{self.hosts[0]}/{self.token}/"


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal is for what matters."""

    def _answer(self, route: Callable[[list[str]], Answer]) -> None:
        path = self._allowed()
        if path is None:
            self.close_connection = True  # its body was not read
            found: Answer = _text(HTTPStatus.FORBIDDEN, "open the address that was printed")
        else:
            try:
                found = route(path)
            except ValidationError as error:
                wrong = "; ".join(e["msg"] for e in error.errors())
                found = _text(HTTPStatus.BAD_REQUEST, wrong)
            except (ValueError, IndexError, RecursionError) as error:
                self.close_connection = True  # its body may not have been read
                found = _text(HTTPStatus.BAD_REQUEST, str(error))
            except HoigsError as error:
                found = _text(HTTPStatus.CONFLICT, str(error))
            except Exception as error:  # a fault of ours: the page says so and goes on
                traceback.print_exc()
                text = f"{type(error).__name__} in the server; its terminal has the details"
                found = _text(HTTPStatus.INTERNAL_SERVER_ERROR, text)
        self._send(*found)

    def _allowed(self) -> list[str] | None:
        """The parts of the path after the token; None if the request is not of our page."""
        parts = urlsplit(self.path).path.split("/")[1:]
        if not secrets.compare_digest(parts[0].encode(), self.server.token.encode()):
            return None
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        ours = self.server.hosts
        if host not in ours or origin not in (None, *(f"http://{h}" for h in ours)):
            return None
        if self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            return None
        return [unquote(part) for part in parts[1:]]

    def _get(self, path: list[str]) -> Answer:
        session = self.server.session
        match path:
            case [""]:
                return HTTPStatus.OK, "text/html; charset=utf-8", self.server.page, ""
            case ["about"]:
                return _json(session.about())
            case ["job"]:
                return _json(session.state())
            case ["frame", number, width]:
                wide = max(16, min(int(width), 4096))
                return _picture(session.video.jpeg(int(number), wide), "image/jpeg")
            case ["tracked", name, number]:
                return _picture(session.tracked(name, int(number)))
            case ["report", name] if Path(name).suffix in REPORT and Path(name).name == name:
                file = session.out / name
                if file.is_file():
                    return HTTPStatus.OK, REPORT[file.suffix], file.read_bytes(), ""
        return _text(HTTPStatus.NOT_FOUND, "nothing is here")

    def _post(self, path: list[str]) -> Answer:
        session, content = self.server.session, self._content()
        match path:
            case ["prompts"]:
                return _json(session.store(content))
            case ["mask"]:
                found = session.clicked(content)
                return _picture(None) if found is None else _picture(found[0], note=found[1])
            case ["look", number]:
                session.clicks.look_at(_frame(number, session))
                return _json({})
            case ["person", number]:
                return _json({"new": session.find_person(_frame(number, session))})
            case ["start"]:
                session.start(content)
                return _json(session.state())
            case ["stop"]:
                session.jobs.stop()
                return _json(session.state())
        return _text(HTTPStatus.NOT_FOUND, "nothing is here")

    def _content(self) -> Any:
        if not self.headers.get("Content-Type", "").startswith("application/json"):
            raise ValueError("expected application/json")
        length = int(self.headers.get("Content-Length", "0"))
        if not 0 < length <= LARGEST:
            self.close_connection = True
            raise ValueError(f"a body of {length} bytes; expected 1 to {LARGEST}")
        return json_value(self.rfile.read(length))

    def _send(self, status: HTTPStatus, kind: str, body: bytes, note: str) -> None:
        secure = (
            f"default-src 'none'; img-src 'self' blob: data:; connect-src 'self'; "
            f"script-src 'nonce-{self.server.nonce}'; style-src 'unsafe-inline'; "
            "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
        )
        if kind.startswith("text/html") and self.path.split("/")[-1] == "report.html":
            secure = "default-src 'none'; img-src 'self' data:; media-src 'self' data:; "
            secure += "style-src 'unsafe-inline'; frame-ancestors 'none'"
        try:
            self.send_response(status)
            for name, value in {
                "Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store",
                "Content-Security-Policy": secure, "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer", "X-Note": json.dumps(note),
                "Cross-Origin-Resource-Policy": "same-origin",
            }.items():  # fmt: skip
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the page has moved on to another frame


def _frame(text: str, session: Session) -> int:
    number = int(text)
    if not 0 <= number < session.video.count:
        raise ValueError(f"there is no frame {number}")
    return number


def _json(content: Any) -> Answer:
    return HTTPStatus.OK, "application/json", json.dumps(content).encode(), ""


def _text(status: HTTPStatus, text: str) -> Answer:
    return status, "text/plain; charset=utf-8", text.encode(), ""


def _picture(data: bytes | None, kind: str = "image/png", note: str = "") -> Answer:
    if data is None:
        return HTTPStatus.NO_CONTENT, kind, b"", ""
    return HTTPStatus.OK, kind, data, note


# annotate: click on people and objects of a video in a local page, and prepare it from there.


def annotate(
    video: Path | str,
    out: Path | str | None = None,
    *,
    port: int = 8091,
    options: PrepareOptions | Path | str | None = None,
    open_browser: bool = False,
    report: Callable[[str], None] = print,
    started: Callable[[PageServer], None] | None = None,
) -> None:
    """Serve the page of one video on this machine's loopback address, until interrupted.

    What is clicked is stored beside the video (`prompt_file`), from where `prepare` reads it.

    Args:
        video: a video, or a folder with one or with frames.
        out: the clip that the page proposes; None: clips/ and the video's or folder's name.
        port: 0 finds a free one.
        options: of the preparations that the page starts, as for `prepare`.
        open_browser: open the page in the user's browser.
        report: receives lines: the address.
        started: receives the server before it serves, for example to shut it down from a thread.

    Raises:
        SourceError: this is no video. SpecError: options, or stored clicks, are wrong.
        HoigsError: the port is in use.
    """
    pyav()
    chosen = PrepareOptions.of(options, verb="annotate")
    found = find_source(Path(video), complete=False).video
    given = clip_named_after(Path(video)) if out is None else Path(out)
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
