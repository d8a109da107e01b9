"""Which names are URLs, and the file system behind one."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.system.downloads import cache_folder, made
from hoigs.core.system.files import read_json
from hoigs.core.system.folder_lock import alive

_URL = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]+):/+(.+)$", re.DOTALL)
# fsspec has more, some of which read other addresses, mount archives or render templates that a
# stranger's file holds; these only read and write files where they say.
SCHEMES = (
    "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "hf", "https", "http", "file", "memory",
)  # fmt: skip
EXTRA = "pip install 'hoigs[storage]' (and s3fs for s3://, gcsfs for gs://, adlfs for az://)"


def as_url(name: str | Path) -> str | None:
    """The URL that a name is, or None: `Path` makes "s3:/bucket/a" of "s3://bucket/a"."""
    found = _URL.match(str(name))
    if found is None:
        return None
    scheme, rest = found.groups()
    return f"{scheme.lower()}://{'/' if scheme.lower() == 'file' else ''}{rest}".rstrip("/")


def file_system(url: str) -> tuple[Any, str]:
    """fsspec's file system of a URL, and the path in it.

    Raises:
        HoigsError: its scheme is none of `SCHEMES`, it is a chain of several, or the package of its
            scheme is not installed.
    """
    scheme = url.partition(":")[0]
    if scheme not in SCHEMES:
        hint = did_you_mean(scheme, SCHEMES)
        raise HoigsError(f"{url}: {scheme}:// is not read; expected {', '.join(SCHEMES)}{hint}")
    if "::" in url:
        raise HoigsError(f"{url}: a chain of several addresses is not read; name the one by ://")
    try:
        import fsspec
    except ImportError as error:
        raise HoigsError(f"{url}: names by URL need fsspec; {EXTRA}") from error
    try:
        return fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise HoigsError(f"{url}: {error}; {EXTRA}") from error
    except ValueError as error:
        raise HoigsError(f"{url}: {error}") from error


@contextmanager
def named_failures(url: str, what: str) -> Iterator[None]:
    """Raise HoigsError, "URL: cannot be WHAT (why)", for whatever the storage raises.

    Every package behind fsspec has exceptions of its own, without a common class: botocore's for
    keys that are absent are no OSError, for instance.
    """
    try:
        yield
    except HoigsError:
        raise
    except Exception as error:
        why = str(error).strip() or "no reason given"
        raise HoigsError(f"{url}: cannot be {what} ({type(error).__name__}: {why})") from error


# Write a folder to a URL, so that readers can tell whether it is whole.

COMPLETE = "complete.json"  # size and SHA-256 of each file; written last


def publish(folder: str | Path, url: str, *, only: Sequence[str] = ()) -> int:
    """Upload a folder to a URL; `complete.json` there, with the checksums, is written last.

    Files that are there already are replaced, and others stay. While it runs, or after it was
    interrupted, there is no `complete.json`. Names that begin with a dot are left out.

    Args:
        only: names of files and folders directly in `folder`; by default all.

    Returns:
        How many files were uploaded, `complete.json` aside.

    Raises:
        HoigsError: `folder` is none or empty, a name of `only` is absent, `url` is no URL, or the
            storage refuses.
    """
    source, target = Path(folder), as_url(url)
    if target is None:
        raise HoigsError(f"{url}: expected a URL, such as s3://bucket/results")
    if not source.is_dir():
        raise HoigsError(f"{source}: no such folder")
    if absent := [name for name in only if not (source / name).exists()]:
        raise HoigsError(f"{source}: has no {', '.join(absent)}")
    files = [file for file in sorted(source.rglob("*")) if _is_wanted(file, source, only)]
    if not files:
        raise HoigsError(f"{source}: has no files to publish")
    fs, root = file_system(target)
    with named_failures(target, "written"):
        if fs.exists(f"{root}/{COMPLETE}"):
            fs.rm_file(f"{root}/{COMPLETE}")
        listed = {}
        for file in files:
            name = file.relative_to(source).as_posix()
            listed[name] = {"size": file.stat().st_size, "sha256": digest_of(file)}
            fs.makedirs(f"{root}/{name}".rpartition("/")[0], exist_ok=True)
            fs.put_file(str(file), f"{root}/{name}")
        fs.pipe_file(f"{root}/{COMPLETE}", json.dumps(listed, indent=1).encode())
    return len(files)


def digest_of(file: Path) -> str:
    """SHA-256 of a file."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _is_wanted(file: Path, source: Path, only: Sequence[str]) -> bool:
    parts = file.relative_to(source).parts
    hidden = any(part.startswith(".") for part in parts) or parts == (COMPLETE,)
    return file.is_file() and not hidden and (not only or parts[0] in only)


# Local copies of what URLs name, in a cache whose size is bounded.

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
        if alive(int(pid)):
            return True
        pin.unlink(missing_ok=True)
    return False
