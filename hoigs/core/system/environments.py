"""An environment for one tool: pinned with hashes, made once, usable only when it is whole.

Packages are first downloaded into a folder that later runs use again, then installed from there
into an environment under a temporary name; it gets its own name when a trial run has passed. A
process that is killed leaves downloads, which the next one continues, and nothing that is used.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from filelock import FileLock

from hoigs.core.errors import HoigsError
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.downloads import NpmFile, cache_folder, made

# A Python of one of the versions that a tool supports.

_PROBE = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"


def find_python(versions: Sequence[str]) -> Path:
    """The running Python if its version is among `versions` ("3.11"), else one on the path.

    Raises:
        HoigsError: there is none that can make environments.
    """
    own = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if own in versions and _works(Path(sys.executable), own):
        return Path(sys.executable)
    for version in versions:
        found = shutil.which(f"python{version}")
        if found and _works(Path(found), version):
            return Path(found)
    raise HoigsError(
        f"no Python {', '.join(versions)} with venv was found (this is {own}); install one, such "
        f"as python{versions[0]} and python{versions[0]}-venv, so that `python{versions[0]}` runs"
    )


def _works(python: Path, version: str) -> bool:
    try:
        answer = subprocess.run(
            [str(python), "-I", "-c", _PROBE],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return answer.returncode == 0 and answer.stdout.strip() == version


MARKER = "hoigs.json"
TAIL = 12  # last lines of a failed program's output that a message shows


class EnvironmentAbsentError(HoigsError):
    """An environment that has to be installed first; the message has the command."""


@dataclass(frozen=True)
class ManagedEnvironment:
    """One environment.

    Attributes:
        name: as in `hoigs estimators install NAME`. summary: what it is for, its size and licences.
        requirements: a file of pip's with one exact version and its hashes a package, all of them.
        pythons: versions of Python that it can have, the best first: "3.12".
        trial: Python code that fails if the environment is unusable.
        files: files to put beside the packages; it can be used without them.
    """

    name: str
    summary: str
    requirements: Path
    pythons: tuple[str, ...]
    trial: str
    files: tuple[NpmFile, ...] = ()

    @property
    def folder(self) -> Path:
        """Where it lies, or will: another file of requirements is another folder."""
        return self._root / self._digest

    @property
    def installed(self) -> bool:
        return (self.folder / MARKER).is_file()

    def python(self) -> Path:
        """Its interpreter.

        Raises:
            EnvironmentAbsentError: it is not installed.
        """
        if not self.installed:
            raise EnvironmentAbsentError(
                f"the environment {self.name} is not installed ({self.summary}); run "
                f"`hoigs estimators install {self.name}`, or the same command with --yes"
            )
        return _python_of(self.folder)

    def file(self, file: NpmFile) -> Path | None:
        """Where one of its files lies; None where the environment or the file is absent."""
        if not self.installed:
            return None
        paths = [packages / file.to for packages in _site_packages(self.folder)]
        return next((path for path in paths if path.is_file()), None)

    def lacking(self) -> dict[str, str]:
        """Files that could not be had, and why."""
        return dict(self._marker().get("lacking", {}))

    def description(self) -> dict[str, Any]:
        """What the marker of an installed environment says: versions, date."""
        return self._marker()

    def install(self, progress: Progress = no_progress) -> None:
        """Makes it, or fetches only the files that an earlier installation could not get.

        Raises:
            HoigsError: no Python fits, or a package cannot be had; what was downloaded is kept.
        """
        with FileLock(made(self._root) / "lock"):
            if not self.installed:
                self._make(progress)
            elif self.lacking():
                self._write_marker(self.folder, self._marker(), progress)
            self._remove_others()
        progress(1.0, f"{self.name} installed")

    def remove(self) -> bool:
        """Removes it with its downloads; False: there was nothing."""
        if not self._root.is_dir():
            return False
        with FileLock(self._root / "lock"):
            if self.folder.is_dir():
                self.folder.rename(self._fresh_part())  # unusable at once, whatever happens next
        shutil.rmtree(self._root)
        return True

    @property
    def _root(self) -> Path:
        return cache_folder() / "environments" / self.name

    @property
    def _digest(self) -> str:
        return hashlib.sha256(self.requirements.read_bytes()).hexdigest()[:12]

    def _fresh_part(self) -> Path:
        """A name of its own: a pip whose parent was killed may go on writing under an older one."""
        return self._root / f".{self._digest}.{uuid.uuid4().hex[:8]}.part"

    def _marker(self) -> dict[str, Any]:
        path = self.folder / MARKER
        if not path.is_file():
            return {}
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return content

    def _make(self, progress: Progress) -> None:
        python = find_python(self.pythons)
        part, packages = self._fresh_part(), self._root / "packages"
        for old in self._root.glob(".*.part"):
            shutil.rmtree(old, ignore_errors=True)
        what = f"installing {self.name}"
        progress(0.02, f"{what}: making an environment with {python}")
        _run([str(python), "-I", "-m", "venv", str(part)], f"{what}: venv")
        pip = [str(_python_of(part)), "-I", "-m", "pip", "--disable-pip-version-check"]
        pinned = ["--require-hashes", "--no-deps", "--only-binary", ":all:", "-r"]
        progress(0.1, f"{what}: downloading packages")
        _run([*pip, "download", "-q", "-d", str(packages), *pinned, str(self.requirements)],
             f"{what}: downloading")  # fmt: skip
        progress(0.6, f"{what}: unpacking packages")
        found = ["--no-index", "--find-links", str(packages)]
        _run([*pip, "install", "-q", *found, *pinned, str(self.requirements)], what)
        progress(0.85, f"{what}: trying it")
        versions = _run([str(_python_of(part)), "-I", "-c", self.trial], f"{what}: its trial run")
        marker = {"made": date.today().isoformat(), "versions": versions.strip()}
        self._write_marker(part, marker, progress)
        part.rename(self.folder)
        shutil.rmtree(packages, ignore_errors=True)

    def _write_marker(self, folder: Path, marker: dict[str, Any], progress: Progress) -> None:
        """Fetches the files, then says that all is there, and what is not."""
        lacking = {}
        packages: dict[str, bytes] = {}
        for file in self.files:
            target = _site_packages(folder)[0] / file.to
            if target.is_file():
                continue
            progress(0.9, f"installing {self.name}: {file.member}")
            try:
                content = file.fetch(packages)
            except HoigsError as error:
                lacking[file.member] = f"{error}; {file.without}"
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            half = target.with_suffix(".part")
            half.write_bytes(content)
            half.replace(target)
        path = folder / MARKER
        half = path.with_suffix(".part")
        half.write_text(json.dumps({**marker, "lacking": lacking}, indent=1), encoding="utf-8")
        half.replace(path)

    def _remove_others(self) -> None:
        """Environments of older requirements, and what killed processes left."""
        for path in self._root.iterdir():
            if path.is_dir() and path not in (self.folder, self._root / "packages"):
                shutil.rmtree(path, ignore_errors=True)


def _python_of(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def _site_packages(folder: Path) -> list[Path]:
    if os.name == "nt":
        return [folder / "Lib" / "site-packages"]
    return [found / "site-packages" for found in (folder / "lib").glob("python*")]


def _run(argv: Sequence[str], what: str) -> str:
    """Standard output of a program; HoigsError with its last lines if it fails."""
    try:
        done = subprocess.run(
            list(argv), capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
        )
    except OSError as error:
        raise HoigsError(f"{what}: cannot run {argv[0]}: {error}") from error
    if done.returncode:
        lines = (done.stdout + done.stderr).strip().splitlines()[-TAIL:]
        said = "\n".join(f"  {line}" for line in lines)
        raise HoigsError(
            f"{what} failed with code {done.returncode}; what was downloaded is kept, and the "
            f"same command goes on from there:\n{said}"
        )
    return done.stdout


# Starting Python without the modules of the folder where it is started.
#
# `python -m` and `python -c` put that folder first on the path: in the folder of a data set, a
# numpy.py of somebody else's would be run in place of NumPy.


# PYTHONPATH counts, as in the process itself
PYTHON = (sys.executable, "-P")
_SAFE = "PYTHONSAFEPATH"


@contextmanager
def safe_children() -> Iterator[None]:
    """As `-P` for what others start in the block, such as the workers of `multiprocessing`."""
    before = os.environ.get(_SAFE)
    os.environ[_SAFE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE]
        else:
            os.environ[_SAFE] = before
