"""Files by URL: published whole, fetched by version into a cache that stays within its bound."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.system.urls import COMPLETE, SCHEMES, as_url, fetched, local_path, publish


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "urls"


@pytest.fixture
def bucket() -> Iterator[str]:
    yield "memory://lab"
    fsspec.filesystem("memory").rm("/lab", recursive=True)


def folder(path: Path, size: int = 10) -> Path:
    (path / "run/checkpoints").mkdir(parents=True)
    (path / "run/evaluation.json").write_text("{}")
    (path / "run/checkpoints/step").write_bytes(b"x" * size)
    (path / "run/.lock").touch()
    (path / "log").touch()
    return path


@pytest.mark.parametrize(
    ("name", "url"),
    [
        (Path("s3://bucket/a b.mp4"), "s3://bucket/a b.mp4"),  # a Path has one slash
        ("S3://bucket/a/", "s3://bucket/a"),
        (Path("file:///data/a"), "file:///data/a"),
        ("builtin:carry?width=64", None),
        ("C:/clips/a", None),
        ("clips/a", None),
    ],
)
def test_what_is_a_url(name: str | Path, url: str | None) -> None:
    assert as_url(name) == url


def test_what_is_published_comes_back(tmp_path: Path, bucket: str, cache: Path) -> None:
    assert publish(folder(tmp_path / "row"), f"{bucket}/row", only=["run"]) == 2
    found = local_path(Path(f"{bucket}/row"))
    files = {p.relative_to(found).as_posix() for p in found.rglob("*") if p.is_file()}
    assert files == {"run/evaluation.json", "run/checkpoints/step", COMPLETE}
    assert found.name == "row" and fetched(f"{bucket}/row") == found
    publish(folder(tmp_path / "new", size=11), f"{bucket}/row")  # another version, another copy
    assert (fetched(f"{bucket}/row") / "run/checkpoints/step").stat().st_size == 11
    assert len([entry for entry in cache.iterdir() if entry.is_dir()]) == 2


def test_an_upload_that_ends_early_leaves_no_sign_of_completeness(
    tmp_path: Path, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(folder(tmp_path / "row"), bucket)
    memory = fsspec.filesystem("memory")
    monkeypatch.setattr(memory, "put_file", lambda *_: (_ for _ in ()).throw(OSError("no room")))
    with pytest.raises(HoigsError, match=r"memory://lab: cannot be written \(OSError: no room\)"):
        publish(tmp_path / "row", bucket)
    assert not memory.exists(f"/lab/{COMPLETE}")


def test_a_damaged_file_is_named(tmp_path: Path, bucket: str, cache: Path) -> None:
    publish(folder(tmp_path / "row"), bucket)
    fsspec.filesystem("memory").pipe_file("/lab/run/checkpoints/step", b"y" * 10)
    with pytest.raises(HoigsError, match=r"not whole: run/checkpoints/step is not what"):
        fetched(bucket)
    assert not list(cache.glob("*")) and not list(cache.glob(".*"))


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"../../x": {"sha256": "0"}}', '{"log": 3}'])
def test_a_list_of_checksums_that_is_none(tmp_path: Path, bucket: str, content: str) -> None:
    publish(folder(tmp_path / "row"), bucket)
    fsspec.filesystem("memory").pipe_file(f"/lab/{COMPLETE}", content.encode())
    with pytest.raises(HoigsError, match=r"complete\.json"):
        fetched(bucket)


def test_what_a_storage_raises_of_its_own_is_a_sentence(
    tmp_path: Path, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As botocore does without keys: a class that is no OSError."""

    class NoCredentialsError(Exception):
        pass

    def refused(*_: object, **__: object) -> None:
        raise NoCredentialsError("Unable to locate credentials")

    publish(folder(tmp_path / "row"), bucket)
    for name, work in (
        ("put_file", lambda: publish(tmp_path / "row", bucket)),
        ("get_file", lambda: fetched(bucket)), ("isfile", lambda: fetched(bucket)),
    ):  # fmt: skip
        with monkeypatch.context() as patch:
            patch.setattr(fsspec.filesystem("memory"), name, refused)
            with pytest.raises(HoigsError, match=r"memory://lab: cannot be .*Unable to locate"):
                work()


def test_the_cache_keeps_to_its_bound_but_for_what_is_in_use(
    tmp_path: Path, bucket: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOIGS_URL_CACHE_GB", "25e-7")  # 2,500 bytes
    memory = fsspec.filesystem("memory")
    for name in "abcd":
        memory.pipe_file(f"/lab/{name}", name.encode() * 1000)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    kept = fetched(f"{bucket}/a")  # by this process
    for name in "bc":
        pin = next((fetched(f"{bucket}/{name}").parent / ".pins").iterdir())
        pin.rename(pin.with_name(f"{pin.name.rpartition('.')[0]}.{gone.pid}"))  # of one that ended
    assert kept.read_text() == "a" * 1000
    assert {p.name for p in cache.glob("*/*") if p.is_file() and p.name != ".used"} == {"a", "c"}
    fetched(f"{bucket}/d")
    with pytest.raises(HoigsError, match="is full of files that are in use; set HOIGS_URL_CACHE"):
        fetched(f"{bucket}/b")
    monkeypatch.setenv("HOIGS_URL_CACHE_GB", "1e-7")
    with pytest.raises(HoigsError, match=r"do not fit a cache of .*; set HOIGS_URL_CACHE_GB"):
        fetched(f"{bucket}/b")


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("memory://lab/gone", "there is no such file or folder"),
        ("memry://lab/gone", 'memry.*did you mean "memory"'),
        ("memory://lab/gone::reference://b", "memory://lab/gone::reference://b: .*chain"),
        ("http://127.0.0.1:9/a", r"http://127\.0\.0\.1:9/a: "),
    ],
)
def test_what_cannot_be_fetched(url: str, message: str) -> None:
    with pytest.raises(HoigsError, match=message):
        fetched(url)


@pytest.mark.parametrize(
    "scheme", sorted(s for s in {*fsspec.available_protocols()} - {*SCHEMES} if as_url(f"{s}://a"))
)
def test_a_scheme_that_may_do_more_than_read_is_refused_before_fsspec_sees_it(
    tmp_path: Path, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fsspec.core, "url_to_fs", None)
    (tmp_path / "a").touch()
    url = f"{scheme}://lab/a::memory://b"
    for work in (lambda: fetched(url), lambda: publish(tmp_path, url)):
        with pytest.raises(HoigsError, match=rf"{re.escape(scheme)}://.* s3, "):
            work()


def test_a_row_is_read_from_s3_and_published_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch against an S3 server on loopback, its stages being processes of their own."""
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1",
        }.items():  # fmt: skip
            monkeypatch.setenv(name, value)
        _batch_on_s3(tmp_path)
    finally:
        server.stop()


def _batch_on_s3(tmp_path: Path) -> None:
    import hoigs
    from hoigs.runs.clip_source import clip_folder

    s3 = fsspec.filesystem("s3")
    s3.mkdir("lab")
    publish(clip_folder("builtin:lift-and-swing?width=48&frames=6"), "s3://lab/clips/lift")
    (tmp_path / "rows.yaml").write_text(
        "rows:\n  - {clip: s3://lab/clips/lift, spec: static, publish: s3://lab/out, device: cpu,"
        " set: [train.steps=1, model.scene.points=200, train.preview_every=0]}\n"
    )
    done = hoigs.batch(tmp_path / "rows.yaml", tmp_path / "out", threads=1)
    assert not done.failed
    listed = json.loads(s3.cat_file(f"lab/out/lift/{COMPLETE}"))
    assert {"run/evaluation.json", "run/spec.yaml"} <= set(listed)
    assert all(s3.size(f"lab/out/lift/{name}") == about["size"] for name, about in listed.items())
