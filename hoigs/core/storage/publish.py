"""Write a folder to a URL, so that readers can tell whether it is whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.storage.urls import as_url, file_system, named_failures

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
