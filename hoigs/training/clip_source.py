"""What a CLIP argument means: a folder, or the name of a built-in clip."""

from __future__ import annotations

from pathlib import Path

from hoigs.core.errors import ClipError
from hoigs.core.registry import Registry, default_registry
from hoigs.synthesis.named import PREFIX, is_named, named_clip


def clip_folder(clip: str | Path, registry: Registry | None = None) -> Path:
    """The folder behind a CLIP argument; a built-in clip is generated unless it is cached.

    Args:
        clip: a folder, or "builtin:NAME" (`hoigs.synthesis.named`).

    Raises:
        ClipError: no built-in clip of that name. A folder is not looked at here.
    """
    if is_named(clip):
        return named_clip(str(clip), (registry or default_registry()).get("body:anny")())
    return Path(clip)


def clip_name(clip: str | Path) -> str:
    """A short name for folders of runs: "carry" of "builtin:carry", else the folder's own."""
    if is_named(clip):
        short, _, query = str(clip).removeprefix(PREFIX).partition("?")
        return "-".join([short, *filter(None, query.replace("=", "-").split("&"))])
    return Path(clip).resolve().name


def require_folder(folder: Path) -> None:
    """ClipError if there is no such folder."""
    if not folder.is_dir():
        raise ClipError(f"{folder}: no such folder; `hoigs prepare VIDEO --out {folder}` makes one")
