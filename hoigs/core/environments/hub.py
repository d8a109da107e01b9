"""Networks of the Hugging Face hub: whether one is in the hub's cache whole, and downloading it.

huggingface_hub downloads, resumes after a cut connection, and obeys `HF_ENDPOINT` and
`HF_HUB_OFFLINE`. It compares the size of what it got, not its checksum; that is done here. Its
cache names each file after the checksum that the hub declares: SHA-256 of weights, git's SHA-1 of
others.
"""

from __future__ import annotations

import hashlib
import json
import os
from functools import cache
from pathlib import Path

from hoigs.core.errors import HoigsError

CONFIG, WEIGHTS, INDEX = "config.json", "model.safetensors", "model.safetensors.index.json"
WANTED = [CONFIG, "*processor_config.json", WEIGHTS, INDEX, "model-*-of-*.safetensors"]
EXTRA = "--estimators hub needs transformers ({}); pip install 'hoigs[estimators]'"


def offline() -> bool:
    """`HF_HUB_OFFLINE` is set."""
    return os.environ.get("HF_HUB_OFFLINE", "0").lower() in ("1", "true", "yes", "on")


def cached(name: str) -> Path | None:
    """The folder of a network "owner/model" in the hub's cache; None unless all of it is there,
    with the right checksums.

    Raises:
        HoigsError: huggingface_hub is not installed.
    """
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError as error:
        raise HoigsError(EXTRA.format(error)) from error
    config = try_to_load_from_cache(name, CONFIG)
    if not isinstance(config, str):
        return None
    folder = Path(config).parent
    return folder if _has_weights(folder) and not _damaged(folder) else None


def fetched(name: str) -> Path:
    """The same, downloaded where it is not there yet.

    Raises:
        HoigsError: it cannot be had, or is not what the hub declares; nothing of that is kept.
    """
    folder = cached(name)
    if folder is not None:
        return folder
    if offline():
        raise HoigsError(
            f"HF_HUB_OFFLINE is set and {name} is not in the hub's cache; unset it, or use "
            "--estimators offline"
        )
    from huggingface_hub import constants, snapshot_download, try_to_load_from_cache

    old = try_to_load_from_cache(name, CONFIG)
    if isinstance(old, str):
        _remove(_damaged(Path(old).parent))  # else what is there would be taken for whole
    try:
        folder = Path(snapshot_download(name, allow_patterns=WANTED))
    except Exception as error:  # of its client, of the disk, of the hub's answers
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise HoigsError(
            f"{name} cannot be downloaded from {constants.ENDPOINT}: {reason[0]}; the files that "
            "are complete are kept, and the same command goes on from there; or use --estimators "
            "offline"
        ) from error
    _remove_abandoned(folder)
    damaged = _damaged(folder)
    _remove(damaged)
    if damaged:
        names = ", ".join(path.name for path in damaged)
        raise HoigsError(
            f"{name}: {names} from {constants.ENDPOINT} has another checksum than the hub "
            "declares, and was removed; try again, or use --estimators offline"
        )
    if not _has_weights(folder):
        raise HoigsError(
            f"{name} on {constants.ENDPOINT} has no {CONFIG} with {WEIGHTS} (other formats may run "
            "code when they are read)"
        )
    return folder


def _remove_abandoned(folder: Path) -> None:
    """Remove what killed downloads left of files that are whole by now: huggingface_hub neither
    continues it nor removes it."""
    for part in (folder.parents[1] / "blobs").glob("*.incomplete"):
        if part.with_name(part.name.partition(".")[0]).is_file():
            part.unlink(missing_ok=True)


def _has_weights(folder: Path) -> bool:
    """The weights are in one file, or in all of those that their index names."""
    if not (folder / CONFIG).is_file():
        return False
    if (folder / WEIGHTS).is_file():
        return True
    try:
        shards = json.loads((folder / INDEX).read_text(encoding="utf-8"))["weight_map"].values()
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False
    return bool(shards) and all((folder / str(shard)).is_file() for shard in set(shards))


def _damaged(folder: Path) -> list[Path]:
    """Files that are not what their names in the cache say."""
    found = []
    for path in sorted(folder.iterdir()):
        blob = path.resolve()
        if path.is_symlink() and blob.is_file():  # without links (Windows) the name is not known
            state = blob.stat()
            if not _sound(blob, state.st_size, state.st_mtime_ns):
                found.append(path)
    return found


@cache
def _sound(blob: Path, size: int, changed: int) -> bool:
    """Whether a file has the checksum that it is named after; read once for each state of it."""
    digest = {64: hashlib.sha256(), 40: hashlib.sha1(b"blob %d\0" % size)}.get(len(blob.name))
    if digest is None:
        return True  # a hub that declares something else
    with blob.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest() == blob.name.lower()


def _remove(paths: list[Path]) -> None:
    for path in paths:
        path.resolve().unlink(missing_ok=True)
        path.unlink(missing_ok=True)
