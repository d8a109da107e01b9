"""`--estimators hub` against a hub on loopback that has tiny networks of random weights.

The weights are random, so what they find means nothing: tested is that they are downloaded, checked
and loaded.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from fnmatch import fnmatch
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from estimator_cases import FRAMES, HEIGHT, WIDTH, request

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import EntityRequest
from hoigs.core.reporting import no_progress
from hoigs.core.system import downloads as hub
from hoigs.preparation.estimates.installed import installed_estimators
from hoigs.preparation.estimates.plan import (
    HUB_LICENCES,
    EstimatorPlan,
    agree,
    get_ready,
    plan_estimators,
)
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.source import find_source

pytest.importorskip("transformers", reason="the extra hoigs[estimators]")
pytestmark = pytest.mark.usefixtures("one_thread")
COMMIT = "0123456789abcdef0123456789abcdef01234567"
SAM2, POSE = "facebook/sam2.1-hiera-tiny", "usyd-community/vitpose-base-simple"
DEPTH, DETECTOR = "depth-anything/Depth-Anything-V2-Small-hf", "PekingU/rtdetr_v2_r18vd"


class Hub(ThreadingHTTPServer):
    """What huggingface_hub reads of a hub: revisions, lists of files, and files by ranges.

    Attributes:
        files: by network, then by name. asked: method, path and range of each request.
        cut: weights are sent to their middle only, so many times. damage: weights are sent wrong.
    """

    def __init__(self, files: dict[str, dict[str, bytes]]) -> None:
        super().__init__(("127.0.0.1", 0), _Answers)
        self.files, self.asked = files, list[tuple[str, str, str | None]]()
        self.cut, self.damage = 0, False

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, *args: object) -> None:
        """Clients go away when they have what they want."""


class _Answers(BaseHTTPRequestHandler):
    server: Hub

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_GET(self) -> None:
        self._answer(body=True)

    def _answer(self, body: bool) -> None:
        self.server.asked.append((self.command, self.path, self.headers.get("Range")))
        path = self.path.partition("?")[0]
        listed = re.fullmatch(r"/api/models/([^/]+/[^/]+)/(revision|tree)/[^/]+", path)
        sent = re.fullmatch(r"/([^/]+/[^/]+)/resolve/[^/]+/(.+)", path)
        if listed and listed[1] in self.server.files:
            files = self.server.files[listed[1]]
            if listed[2] == "revision":
                answer: object = {"id": listed[1], "sha": COMMIT, "siblings": []}
            else:
                answer = [_entry(name, content) for name, content in files.items()]
            self._send(json.dumps(answer).encode(), {"Content-Type": "application/json"}, body)
        elif sent and sent[2] in self.server.files.get(sent[1], {}):
            self._file(sent[2], self.server.files[sent[1]][sent[2]], body)
        else:
            self.send_error(404)

    def _file(self, name: str, content: bytes, body: bool) -> None:
        weights = name.endswith(".safetensors")
        headers = {"X-Repo-Commit": COMMIT, "ETag": f'"{_checksum(name, content)}"',
                   "Accept-Ranges": "bytes"}  # fmt: skip
        if weights:
            headers |= {"X-Linked-ETag": headers["ETag"], "X-Linked-Size": str(len(content))}
        whole = len(content)
        if weights and self.server.damage:
            content = content[:-1] + bytes([content[-1] ^ 1])
        start = int((self.headers.get("Range") or "bytes=0-")[6:].partition("-")[0])
        if start:
            headers["Content-Range"] = f"bytes {start}-{whole - 1}/{whole}"
        most = None
        if weights and body and self.server.cut > 0:
            self.server.cut -= 1
            most = max(whole // 2 - start, 0)
        self._send(content[start:], headers, body, 206 if start else 200, most)

    def _send(self, content: bytes, headers: dict[str, str], body: bool, status: int = 200,
              most: int | None = None) -> None:  # fmt: skip
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(content[:most])

    def log_message(self, *args: object) -> None:
        pass


def _checksum(name: str, content: bytes) -> str:
    """As the hub declares it: SHA-256 of large files, git's of others."""
    if name.endswith(".safetensors"):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def _entry(name: str, content: bytes) -> dict[str, object]:
    return {"type": "file", "path": name, "size": len(content), "oid": _checksum(name, content)}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; huggingface_hub reads the variables of the environment when imported."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    return tmp_path / "cache"


@pytest.fixture
def loopback(
    cache: Path, sam2: Path, vitpose: Path, depth: Path, rtdetr: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Hub]:  # fmt: skip
    from huggingface_hub import constants
    from huggingface_hub.utils import _http

    folders = {SAM2: sam2, POSE: vitpose, DEPTH: depth, DETECTOR: rtdetr}
    contents = {n: {p.name: p.read_bytes() for p in f.iterdir()} for n, f in folders.items()}
    server = Hub(contents)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    monkeypatch.setattr(constants, "ENDPOINT", server.url)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE",
                        server.url + "/{repo_id}/resolve/{revision}/{filename}")  # fmt: skip
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 1 << 16)  # what a cut may lose: 10 MB
    monkeypatch.setattr(_http.time, "sleep", lambda seconds: None)  # between tries
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def plan(tmp_path: Path) -> EstimatorPlan:
    """That of a video with nothing beside it."""
    (tmp_path / "video.mp4").write_bytes(b"no frames are read")
    source = find_source(tmp_path / "video.mp4", complete=False)
    return plan_estimators(source, PrepareOptions(preset="hub"))


def weights_sent(server: Hub) -> list[str | None]:
    """Ranges of the requests for SAM 2's weights."""
    wanted = f"/{SAM2}/resolve/*/{hub.WEIGHTS}"
    return [part for how, path, part in server.asked if how == "GET" and fnmatch(path, wanted)]


def test_all_networks_of_the_preset_are_downloaded_and_find_things_in_a_frame(
    plan: EstimatorPlan, loopback: Hub, tmp_path: Path
) -> None:
    assert not (tmp_path / "cache").exists()
    questions: list[str] = []

    def listens(question: str) -> bool:
        assert not loopback.asked, "nothing is downloaded before the answer"
        questions.append(question)
        return False

    for consent in (listens, None):  # refused, and nobody to answer
        with pytest.raises(HoigsError, match=r"Apache-2\.0: SAM 2\.1.*add --yes"):
            get_ready(plan, {}, consent, no_progress)
    assert len(questions) == 1 and HUB_LICENCES in questions[0]
    assert all(name in questions[0] for name in (SAM2, POSE, DEPTH, DETECTOR))
    assert not loopback.asked and not (tmp_path / "cache").exists()

    get_ready(plan, {}, agree, no_progress)
    asked = len(loopback.asked)
    get_ready(plan, {}, None, no_progress)  # all is there
    video = request(tmp_path, wanted=(0,), entities=(EntityRequest("human", "human"),))
    specs = {
        place: spec.model_copy(update=({"threshold": 0.0} if place != "depth" else {}))
        for place, spec in plan.specs().items()
        if place != "object"
    }
    chosen = installed_estimators(specs)
    masks = chosen["masks"].estimate(video, no_progress).masks
    assert masks is not None and masks.entities["human"][0].shape == (HEIGHT, WIDTH)
    points = chosen["landmarks"].estimate(video, no_progress).landmarks["human"]
    assert points.image_xyzv.shape == (FRAMES, 33, 4)
    maps = chosen["depth"].estimate(video, no_progress).depth
    assert maps is not None and maps.maps[0].shape == (HEIGHT, WIDTH)
    assert len(loopback.asked) == asked, "what is in the cache is loaded without the hub"


def test_a_cut_connection_goes_on_where_it_was(loopback: Hub) -> None:
    loopback.cut = 1
    folder = hub.fetched(SAM2)
    content = loopback.files[SAM2][hub.WEIGHTS]
    first, second = weights_sent(loopback)
    assert first is None and second is not None
    assert len(content) // 2 - (1 << 16) < int(second[6:-1]) <= len(content) // 2
    assert (folder / hub.WEIGHTS).read_bytes() == content and hub.cached(SAM2) == folder


def test_a_download_that_fails_is_not_taken_for_a_network(loopback: Hub, cache: Path) -> None:
    loopback.cut = 1000
    with pytest.raises(HoigsError, match=rf"{SAM2} cannot be downloaded from http://127.*goes on"):
        hub.fetched(SAM2)
    assert not list(cache.rglob("*.incomplete")) and not list(cache.rglob(hub.WEIGHTS))
    assert list(cache.rglob(hub.CONFIG)) and hub.cached(SAM2) is None
    loopback.cut = 0
    assert hub.fetched(SAM2) == hub.cached(SAM2)


def test_what_a_killed_download_left_goes_when_the_file_is_whole(
    loopback: Hub, cache: Path
) -> None:
    blobs = cache / f"models--{SAM2.replace('/', '--')}" / "blobs"
    digest = hashlib.sha256(loopback.files[SAM2][hub.WEIGHTS]).hexdigest()
    left = blobs / f"{digest}.0123abcd.incomplete"
    other = blobs / f"{'0' * 64}.0123abcd.incomplete"
    blobs.mkdir(parents=True)
    left.write_bytes(b"half")
    other.write_bytes(b"of a file that is not whole, which another process may be writing")
    hub.fetched(SAM2)
    assert list(blobs.glob("*.incomplete")) == [other]


def test_another_checksum_is_refused_and_not_kept(loopback: Hub, cache: Path) -> None:
    loopback.damage = True
    with pytest.raises(HoigsError, match=r"model\.safetensors from http.* has another checksum"):
        hub.fetched(SAM2)
    right = loopback.files[SAM2][hub.WEIGHTS]
    kept = [p for p in cache.rglob("*") if p.is_file() and p.stat().st_size == len(right)]
    assert not kept and hub.cached(SAM2) is None
    loopback.damage = False
    blob = (hub.fetched(SAM2) / hub.WEIGHTS).resolve()
    blob.write_bytes(right[:-1] + bytes([right[-1] ^ 1]))  # on the disk, after it was checked
    assert hub.cached(SAM2) is None
    assert (hub.fetched(SAM2) / hub.WEIGHTS).read_bytes() == right


def test_offline_without_a_cache(
    plan: EstimatorPlan, loopback: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(HoigsError, match=r"HF_HUB_OFFLINE is set and .*use --estimators offline"):
        get_ready(plan, {}, agree, no_progress)
    with pytest.raises(HoigsError, match=f"HF_HUB_OFFLINE is set and {SAM2} is not"):
        hub.fetched(SAM2)
    assert not loopback.asked


def test_weights_in_shards_are_there_when_all_of_them_are(loopback: Hub) -> None:
    files = loopback.files[SAM2]
    content = files.pop(hub.WEIGHTS)
    index = {"weight_map": {"a": "model-00001-of-00002.safetensors",
                            "b": "model-00002-of-00002.safetensors"}}  # fmt: skip
    files |= {hub.INDEX: json.dumps(index).encode(), "model-00001-of-00002.safetensors": content}
    with pytest.raises(HoigsError, match=r"has no config\.json with model\.safetensors"):
        hub.fetched(SAM2)
    assert hub.cached(SAM2) is None
