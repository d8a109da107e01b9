"""Local copies of what URLs name, in a cache whose size is bounded."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

from hoigs.core.environments.cache import cache_folder, made
from hoigs.core.errors import HoigsError
from hoigs.core.files.json_file import read_json
from hoigs.core.storage.publish import COMPLETE, digest_of
from hoigs.core.storage.urls import as_url, file_system, named_failures

LIMIT = "HOIGS_URL_CACHE_GB"
DEFAULT_GB = 50.0
USED = ".used"  # its time: when the entry was last asked for
PIN_S = 86_400.0  # for which a process of another machine is taken to be alive


def local_path(name: str | Path) -> Path:
    """A path as it is; of a URL, the local copy of the file or folder.

    Raises:
        HoigsError: as `fetched`.
    """
    url = as_url(name)
    return Path(name) if url is None else fetched(url)


def fetched(url: str) -> Path:
    """The local copy of a file or folder, downloaded unless the cache has just this version.

    A version is the names, sizes and, where the storage has them, checksums or times of the files.
    What `publish` wrote is compared with its checksums. Copies that no process uses are removed,
    the ones used longest ago first, so that all take at most HOIGS_URL_CACHE_GB (50).

    Raises:
        HoigsError: nothing is there, it is not whole, it cannot be read, or it is larger than the
            cache may be.
    """
    fs, path = file_system(url)
    with named_failures(url, "read"):
        files = _files(fs, path)
    if not files:
        raise HoigsError(f"{url}: {_why_nothing(fs, path)}")
    root = cache_folder() / "urls"
    key = hashlib.sha256(json.dumps([url, files], sort_keys=True).encode()).hexdigest()[:32]
    entry = root / key
    target = entry / (path.rstrip("/").rpartition("/")[2] or "files")
    if not (entry / USED).is_file():
        _make_room(root, sum(size for size, _ in files.values()), url)
        _download(fs, path, files, entry, target, url)
    _pin(entry)
    return target


def _files(fs: Any, path: str) -> dict[str, tuple[int, str]]:
    """Size and version of each file, by its name from `path`; "" is `path` itself."""
    if fs.isfile(path):
        return {"": _version(fs.info(path))}
    found = fs.find(path, detail=True) if fs.exists(path) else {}
    start = len(path.rstrip("/")) + 1
    return {name[start:]: _version(info) for name, info in found.items() if name[start:]}


def _why_nothing(fs: Any, path: str) -> str:
    """Why there are no files: fsspec takes what it cannot reach for absent, and keeps the cause."""
    try:
        fs.info(path)
    except Exception as error:  # as `named_failures`
        cause = error.__cause__
        if isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError):
            return f"the address cannot be reached ({cause}); check it and the network"
    return "there is no such file or folder, or it is empty"


def _version(info: dict[str, Any]) -> tuple[int, str]:
    marks = ("ETag", "etag", "md5Hash", "content_md5", "LastModified", "mtime", "created")
    mark = next((str(info[m]) for m in marks if info.get(m)), "")
    return int(info.get("size") or 0), mark


def _download(
    fs: Any, path: str, files: dict[str, tuple[int, str]], entry: Path, target: Path, url: str
) -> None:
    part = Path(tempfile.mkdtemp(prefix=f".{entry.name}.", dir=made(entry.parent)))
    try:
        for name, (size, _) in files.items():
            to = part / target.name / name if name else part / target.name
            if not to.resolve().is_relative_to((part / target.name).resolve()):
                raise HoigsError(f"{url}: a file's name leaves the folder: {name}")
            to.parent.mkdir(parents=True, exist_ok=True)
            with named_failures(url, "downloaded"):
                fs.get_file(f"{path.rstrip('/')}/{name}" if name else path, str(to))
            if size and to.stat().st_size != size:
                raise HoigsError(
                    f"{url}/{name}: {to.stat().st_size} of {size} bytes arrived; try again"
                )
        _compare(part / target.name, url)
        (part / USED).touch()
        try:
            part.rename(entry)
        except OSError:
            if not (entry / USED).is_file():  # else another process was faster, with the same files
                raise
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _compare(folder: Path, url: str) -> None:
    """With the checksums of `publish`, where it was written by that."""
    listed = folder / COMPLETE
    if not listed.is_file():
        return
    record = read_json(listed, error=HoigsError, advice=f"publish {url} again")
    if not isinstance(record, dict) or not record:
        raise HoigsError(f"{url}: {COMPLETE} lists no files; publish again")
    for name, about in record.items():
        file = folder / name
        inside = file.resolve().is_relative_to(folder.resolve())
        known = about.get("sha256") if isinstance(about, dict) else None
        if not inside or not file.is_file() or digest_of(file) != known:
            raise HoigsError(f"{url}: not whole: {name} is not what {COMPLETE} says; publish again")


def _make_room(root: Path, needed: int, url: str) -> None:
    """Remove what was used longest ago, and is not used now, until `needed` bytes fit."""
    text = os.environ.get(LIMIT, str(DEFAULT_GB))
    try:
        limit = float(text) * 1e9
    except ValueError as error:
        raise HoigsError(f"{LIMIT}: expected a number of gigabytes, got {text!r}") from error
    if needed > limit:
        raise HoigsError(
            f"{url}: {needed / 1e9:.2f} GB do not fit a cache of {limit / 1e9:g} GB; set {LIMIT}"
        )
    entries = [entry for entry in root.glob("*") if (entry / USED).is_file()]
    entries.sort(key=lambda entry: (entry / USED).stat().st_mtime)
    sizes = {entry: _size(entry) for entry in entries}
    total = sum(sizes.values())
    for entry in entries:
        if total + needed <= limit:
            return
        if not _is_pinned(entry):
            gone = entry.with_name(f".{entry.name}.{os.getpid()}.gone")
            with contextlib.suppress(OSError):  # removed by another process
                entry.rename(gone)
                shutil.rmtree(gone)
            total -= sizes[entry]
    if total + needed > limit:
        raise HoigsError(
            f"{url}: the cache of {limit / 1e9:g} GB is full of files that are in use; set {LIMIT}"
        )


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def _pin(entry: Path) -> None:
    """Note that this process uses an entry."""
    os.utime(entry / USED)
    pins = entry / ".pins"
    pins.mkdir(exist_ok=True)
    (pins / f"{socket.gethostname()}.{os.getpid()}").touch()


def _is_pinned(entry: Path) -> bool:
    for pin in (entry / ".pins").glob("*"):
        host, _, pid = pin.name.rpartition(".")
        if host != socket.gethostname():
            if time.time() - pin.stat().st_mtime < PIN_S:
                return True
            continue
        try:
            os.kill(int(pid), 0)
        except ProcessLookupError:
            pin.unlink(missing_ok=True)
        except PermissionError:  # it lives, and is another user's
            return True
        else:
            return True
    return False
