"""Which names are URLs, and the file system behind one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError, did_you_mean

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
