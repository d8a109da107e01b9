"""RunFolder: spec.yaml, provenance.json, metrics.jsonl and checkpoints/ of one run.

Paths in it are relative, so the folder can be moved.
"""

from __future__ import annotations

import glob
import json
import os
import platform
import shlex
import shutil
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from hoigs.core.errors import HoigsError
from hoigs.core.system.files import (
    did_you_mean_beside,
    failures_named,
    read_json,
    validated,
    write_whole,
)
from hoigs.core.system.folder_lock import FolderLock, alive
from hoigs.core.system.safe_replace import (
    Layout,
    one_of,
    put_in_place,
    refuse_unwritable,
    require_replaceable,
)

# What the JSON files of a run hold: the content that is checked when they are read back.

Text = Annotated[str, Field(pattern=r"^[^\x00]*$")]
Count = Annotated[int, Field(ge=0, le=2**31 - 1, strict=True)]


class _Record(BaseModel):
    """Keys beyond the declared ones are kept: later versions may write more."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class ReaderRecord(_Record):
    """The reader of a run's clip."""

    use: Text
    settings: dict[str, Any]


class ClipRecord(_Record):
    """The clip of a run; `path` is relative to the run."""

    path: Text
    name: Text = ""
    reader: ReaderRecord | None = None


class FaultRecord(_Record):
    """A defect of the clip that training tolerated."""

    what: Text
    do: Text


class Provenance(_Record):
    """provenance.json."""

    clip: ClipRecord
    versions: dict[str, Any] = {}
    command: str = ""
    components: dict[str, Any] = {}
    allow_faults: bool = False
    clip_faults: list[FaultRecord] = []
    clip_provenance: dict[str, Any] = {}
    cuda_graphs: dict[str, Any] = {}


class SamplerRecord(_Record):
    """Frames that are left of the present epoch."""

    queue: list[Count]


class CheckpointRecord(_Record):
    """step_000123.json beside a checkpoint's tensors."""

    version: int
    step: Count
    time_s: Annotated[float, Field(ge=0)]
    counts: dict[str, Count]
    spec_name: str
    model_hash: str
    sampler: SamplerRecord | None = None
    skipped: list[tuple[int, str]] = []


class StreamRecord(_Record):
    """One tensor of a compact checkpoint."""

    shape: list[Count]
    dtype: str
    crc32: Annotated[int, Field(ge=0, strict=True)]
    bits: Literal[8, 16] | None = None


class CompactRecord(CheckpointRecord):
    """The same of a compact checkpoint."""

    tensors: dict[str, StreamRecord]
    composed: list[str]


class StepRecord(BaseModel):
    """The part of a line of metrics.jsonl that resuming needs."""

    step: Count


class MetricsRecord(StepRecord):
    """A line of metrics.jsonl; the PSNR of equal images is infinite."""

    time_s: Annotated[float, Field(ge=0)]
    loss: float
    losses: dict[str, float] = {}
    counts: dict[str, Count] = {}
    psnr: dict[str, float] = {}


PACKAGES = ("hoigs", "torch", "warp-lang", "kornia", "pluggy", "numpy")
_PROTOCOL = "(auto|given|interpolated|fitted)"
_WRITTEN_WHOLE = (
    r"(spec\.yaml|provenance\.json|job\.json|study\.json|report\.html"
    rf"|evaluation(-{_PROTOCOL}-{_PROTOCOL})?\.json)"
)
# what train, eval, compress, render, export and studies write into a run, half-written files
# included; exporters name their own files
RUN = Layout(
    what="run",
    maker="hoigs",
    required=("spec.yaml", "provenance.json", "checkpoints"),
    files=one_of(
        _WRITTEN_WHOLE,
        rf"\.{_WRITTEN_WHOLE}\.part",
        r"metrics\.(jsonl|part)",
        r"clip\.npz|\.clip\.npz\.part",
        r"checkpoints/step_\d+\.((safetensors|json)(\.part)?|\d+\.part)",
        r"renders/[^/]+\.(mp4|webm|mov|gif)(\.part)?",
        r"exports/.+",
        r"windows/\d+\.(values|exp_avg|exp_avg_sq)",  # of a training that was killed
    ),
    folders=one_of("checkpoints", "renders", "windows", "exports(/.+)?"),
)


class RunFolder:
    """The files of one training run.

    Args:
        path: the folder; `create` makes it, once all input has been checked.

    Attributes:
        kept_clip: the clip without its pixels (`hoigs.runs.kept_clip`); older runs have none.
        windows: files of a training in windows, while it runs.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.spec, self.provenance = path / "spec.yaml", path / "provenance.json"
        self.metrics, self.checkpoints = path / "metrics.jsonl", path / "checkpoints"
        self.kept_clip, self.windows = path / "clip.npz", path / "windows"
        self._lock: FolderLock | None = None
        self._created = False

    def lock(self, work: str) -> None:
        """Keep other processes from writing this run, until `unlock` or the end of this process.

        Raises:
            HoigsError: another process writes it.
        """
        self._lock = FolderLock(self.path, work).acquire()

    def unlock(self) -> None:
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def require_lock(self) -> None:
        """Raise HoigsError if another process took over the lock that this one had."""
        if self._lock is not None:
            self._lock.require_held()

    def keep_clip_of(self, other: RunFolder) -> None:
        """Take over what another run keeps of its clip, if it keeps anything."""
        if other.kept_clip.is_file():
            shutil.copyfile(other.kept_clip, self.kept_clip)

    def require(self) -> None:
        """Raise HoigsError unless this is a run."""
        missing = RUN.missing(self.path)
        if missing and not self.path.exists():
            raise HoigsError(
                f"{self.path}: no such folder{did_you_mean_beside(self.path, 'spec.yaml')} "
                f"`hoigs train CLIP --out {self.path}` makes one"
            )
        if missing and (self.path / "clip.json").is_file():
            raise HoigsError(
                f"{self.path}: a clip, not yet a run; "
                f"`hoigs train {self.path} --out runs/{self.path.name}` makes one of it"
            )
        if missing:
            raise HoigsError(
                f"{self.path}: not a run folder, {', '.join(missing)} absent; "
                "`hoigs train CLIP --out RUN` makes one"
            )

    def refuse_existing(
        self, overwrite: bool, inputs: Iterable[Path | str] = (), *, resumable: bool = False
    ) -> None:
        """Raise HoigsError unless a run may be created here.

        Args:
            overwrite: allow an older run here, if it is complete and has no foreign files.
            inputs: sources of the new run, which must not be inside the old one.
            resumable: whether the command has --resume, for the message.
        """
        refuse_unwritable(self.path)
        if not overwrite and self.path.is_dir() and any(self.path.iterdir()):
            resume = " go on with --resume," if resumable else ""
            raise HoigsError(
                f"{self.path}: already exists; choose another --out,{resume} or replace it with "
                "--overwrite"
            )
        require_replaceable(self.path, RUN, inputs=map(Path, inputs))

    def require_room(self, needed: int) -> None:
        """Raise HoigsError if the disk has no room for a first checkpoint of `needed` bytes."""
        parent = self.path.absolute().parent
        while not parent.exists():
            parent = parent.parent
        free = shutil.disk_usage(parent).free
        if free < needed:
            raise HoigsError(
                f"{self.path}: a checkpoint takes {needed / 1e6:.1f} MB and more, and {parent} has "
                f"{free / 1e6:.1f} MB left; make room, or name a folder on another disk"
            )

    def replace_by(
        self, new: RunFolder, overwrite: bool, inputs: Iterable[Path | str] = ()
    ) -> None:
        """Rename a finished run to this one; arguments as for `refuse_existing`."""
        self.refuse_existing(overwrite, inputs)
        with FolderLock(self.path, "replacing it"):
            put_in_place(new.path, self.path)

    def create(
        self,
        spec_text: str,
        provenance: dict[str, Any],
        overwrite: bool = False,
        inputs: Iterable[Path | str] = (),
    ) -> None:
        """Make the folder under a temporary name, then rename it into place.

        Temporary folders of killed processes are removed. `overwrite` and `inputs` are as for
        `refuse_existing`.

        Raises:
            HoigsError: as `refuse_existing`; or a name in `provenance` is no text in UTF-8.
        """
        self.refuse_existing(overwrite, inputs)
        _require_text(provenance)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for stale in self.path.parent.glob(f".{glob.escape(self.path.name)}.*.part"):
            pid = stale.name.split(".")[-2]
            if pid.isdigit() and not alive(int(pid)):
                shutil.rmtree(stale)
        temporary = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            with failures_named(self.path):
                (temporary / "checkpoints").mkdir(parents=True)
                (temporary / "spec.yaml").write_text(spec_text)
                (temporary / "provenance.json").write_text(json.dumps(provenance, indent=1))
                (temporary / "metrics.jsonl").touch()
                put_in_place(temporary, self.path)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        self._created = True

    def remove_unstarted(self) -> None:
        """Remove the run if this object created it and it has no checkpoint yet."""
        if not self._created or any(self.checkpoints.iterdir()) or any(RUN.foreign(self.path)):
            return
        if self._lock is None or not self._lock.is_lost():
            shutil.rmtree(self.path, ignore_errors=True)

    def update(self, spec_text: str, changed: dict[str, Any]) -> None:
        """Replace the spec of a resumed run, and the `changed` keys of its provenance."""
        record = self.read_provenance() | changed
        for path, text in ((self.spec, spec_text), (self.provenance, json.dumps(record, indent=1))):
            write_whole(path, text)

    def log(self, record: dict[str, Any]) -> None:
        """Append a line to metrics.jsonl."""
        with failures_named(self.metrics), self.metrics.open("a") as file:
            file.write(json.dumps(record) + "\n")

    def cut_metrics(self, step: int) -> None:
        """Drop records after `step`, which a resumed run writes again, and an unfinished line."""
        kept = [record for record in self.read_metrics(StepRecord) if record["step"] <= step]
        text = "".join(json.dumps(record) + "\n" for record in kept)
        write_whole(self.metrics, text, self.metrics.with_suffix(".part"))

    def read_provenance(self) -> dict[str, Any]:
        """provenance.json, checked.

        Raises:
            HoigsError: it is damaged.
        """
        advice = "restore it from a copy, or train again"
        content = read_json(self.provenance, error=HoigsError, advice=advice)
        validated(content, Provenance, self.provenance, error=HoigsError, advice=advice)
        return dict(content)

    def read_metrics(self, record: type[StepRecord] = MetricsRecord) -> list[dict[str, Any]]:
        """The records of metrics.jsonl; none if the file is absent. An unfinished line is left out.

        Raises:
            HoigsError: a line is damaged; the message has its number.
        """
        try:
            whole = self.metrics.read_text(encoding="utf-8").rpartition("\n")[0]
        except FileNotFoundError:
            return []
        except ValueError as error:
            raise HoigsError(f"{self.metrics}: damaged, not text in UTF-8; delete it") from error
        records = []
        for number, line in enumerate(whole.splitlines(), 1):
            place, advice = f"{self.metrics}:{number}", "delete the line"
            try:
                content = json.loads(line)
            except (ValueError, RecursionError) as error:
                raise HoigsError(f"{place}: damaged, not JSON ({error}); {advice}") from error
            validated(content, record, place, error=HoigsError, advice=advice)
            records.append(content)
        return records

    def relative(self, path: Path) -> str:
        """`path` relative to the run folder, so that both can move together."""
        return os.path.relpath(path.resolve(), self.path.resolve())


def _require_text(provenance: dict[str, Any]) -> None:
    """Raise HoigsError where the record could not be read back: of a path that is no UTF-8."""
    try:
        json.dumps(provenance, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        name = error.object[max(0, error.start - 30) : error.end]
        raise HoigsError(
            f"...{name!r}: a name that is not text in UTF-8; rename the file or folder"
        ) from error


def versions() -> dict[str, str]:
    """Versions of the packages that decide a result, of Python, and the machine."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["python"] = platform.python_version()
    found["machine"] = f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs"
    return found


def command_line() -> dict[str, str]:
    """The `hoigs` command of this process under "command"; empty if it is another program."""
    program = Path(sys.argv[0])
    if program.stem != "hoigs" and program.parts[-2:] != ("hoigs", "__main__.py"):
        return {}
    return {"command": shlex.join(["hoigs", *sys.argv[1:]])}
