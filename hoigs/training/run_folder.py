"""A run folder: spec.yaml, provenance.json, metrics.jsonl, checkpoints/. Movable as a whole."""

from __future__ import annotations

import glob
import json
import os
import platform
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError

PACKAGES = ("hoigs", "torch", "warp-lang", "kornia", "pluggy", "numpy")


class RunFolder:
    """The files of one training run.

    Args:
        path: the folder; made by `create`, which nothing calls before all input has been checked.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def spec(self) -> Path:
        return self.path / "spec.yaml"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def provenance(self) -> Path:
        return self.path / "provenance.json"

    def require(self) -> None:
        """Raise unless this is a run."""
        missing = [f.name for f in (self.spec, self.provenance, self.checkpoints) if not f.exists()]
        if missing:
            raise HoigsError(
                f"{self.path}: not a run folder, {', '.join(missing)} absent; "
                "`hoigs train CLIP --out RUN` makes one"
            )

    def refuse_existing(self, overwrite: bool) -> None:
        if self.path.exists() and any(self.path.iterdir()):
            if not overwrite:
                raise HoigsError(
                    f"{self.path}: already exists; choose another --out, go on with --resume, or "
                    "replace it with --overwrite"
                )
            if not self.spec.exists():
                raise HoigsError(f"{self.path}: --overwrite replaces run folders only")

    def create(self, spec_text: str, provenance: dict[str, Any], overwrite: bool = False) -> None:
        """Make the folder under a temporary name, then rename it into place.

        What an earlier process that was killed here has left beside it is removed.
        """
        self.refuse_existing(overwrite)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for stale in self.path.parent.glob(f".{glob.escape(self.path.name)}.*.part"):
            if not _alive(stale.name.split(".")[-2]):
                shutil.rmtree(stale)
        temporary = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        shutil.rmtree(temporary, ignore_errors=True)
        (temporary / "checkpoints").mkdir(parents=True)
        (temporary / "spec.yaml").write_text(spec_text)
        (temporary / "provenance.json").write_text(json.dumps(provenance, indent=1))
        (temporary / "metrics.jsonl").touch()
        old = self.path.with_name(f".{self.path.name}.old.{os.getpid()}.part")
        if self.path.exists():
            self.path.replace(old)
        temporary.replace(self.path)
        shutil.rmtree(old, ignore_errors=True)

    def go_on(self, spec_text: str, changed: dict[str, Any]) -> None:
        """A resumed run is from now on one of this spec (more steps, another cap) and clip.

        Args:
            changed: of its provenance.
        """
        record = self.read_provenance() | changed
        for path, text in ((self.spec, spec_text), (self.provenance, json.dumps(record, indent=1))):
            temporary = path.with_name(f".{path.name}.part")
            temporary.write_text(text)
            temporary.replace(path)

    def log(self, record: dict[str, Any]) -> None:
        with self.metrics.open("a") as file:
            file.write(json.dumps(record) + "\n")

    def cut_metrics(self, step: int) -> None:
        """Drop records after `step`: a resumed run writes them again.

        A last line without its end was being written when the run was killed: it goes too.
        """
        whole = self.metrics.read_text().rpartition("\n")[0]
        kept = [line for line in whole.splitlines() if json.loads(line)["step"] <= step]
        temporary = self.metrics.with_suffix(".part")
        temporary.write_text("".join(line + "\n" for line in kept))
        temporary.replace(self.metrics)

    def read_provenance(self) -> dict[str, Any]:
        return json.loads(self.provenance.read_text())

    def relative(self, path: Path) -> str:
        """`path` as seen from the run folder, so that both can move together."""
        return os.path.relpath(path.resolve(), self.path.resolve())


def _alive(pid: str) -> bool:
    """Whether a process of this number runs; what is no number belongs to nobody we know."""
    if not pid.isdigit():
        return True
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def versions() -> dict[str, str]:
    """Versions of what decides a result, and the machine."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["python"] = platform.python_version()
    found["machine"] = f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs"
    return found
