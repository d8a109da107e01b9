"""Files that appear whole or not at all, beside what they replace."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def named(path: Path) -> Path:
    """`path` with a name of its own, so that others can be made of it: that of the folder itself
    in place of "." and ".."."""
    return path.resolve() if path.name in ("", "..") else path


@contextmanager
def failures_named(path: Path) -> Iterator[None]:
    """Errors of the system in the block that name no file name this one: a full disk is noticed by
    write(), which knows no name."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def written_whole(path: Path, temporary: Path | None = None) -> Iterator[Path]:
    """A temporary name to write to, renamed to `path` after the block and removed if it fails.

    Args:
        temporary: by default ".NAME.part" beside it.
    """
    temporary = temporary or path.with_name(f".{path.name}.part")
    try:
        with failures_named(path):
            yield temporary
            temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: str | bytes, temporary: Path | None = None) -> None:
    """Write a file through a temporary name; text as UTF-8."""
    with written_whole(path, temporary) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
