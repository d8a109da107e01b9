"""Job: one training and its scores, with its run folder and state."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar, Self

from hoigs.core.errors import CheckpointError, ClipError, SpecError
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.system.files import write_whole

RECORD = "job.json"
SCORES = "evaluation.json"
SEED = "train.seed"


class JobState(StrEnum):
    """done: scored, by this spec on this clip. started: has a checkpoint of it. absent: neither."""

    done = "done"
    started = "started"
    absent = "absent"


@dataclass(frozen=True)
class Job:
    """A spec to train on a clip.

    Attributes:
        clip: folder of the clip, on disk. clip_label: as the user named it.
        clip_digest: of its content, `digest_folder`.
        spec: name or file. settings: laid over it, seed and steps included.
        spec_hash: of the resolved spec. run: its run folder.
        device, lpips_weights, plugins: as for `hoigs train`.
        worker: module that runs it, in a process of its own.
    """

    worker: ClassVar[str] = "hoigs.studies.jobs.worker"

    clip: str
    clip_label: str
    clip_digest: str
    spec: str
    settings: tuple[str, ...]
    spec_hash: str
    run: str
    device: str = "cpu"
    lpips_weights: str | None = None
    plugins: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        return Path(self.run)

    @property
    def log(self) -> Path:
        """What the job printed, beside its run folder."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def lease(self) -> Path:
        """What the driver of this job locks; the run folder itself is locked by its training."""
        return self.folder.with_name(f"{self.folder.name}.job")

    @property
    def identity(self) -> dict[str, str]:
        """A run with another identity belongs to another job, and is replaced."""
        return {"spec_hash": self.spec_hash, "clip_digest": self.clip_digest}

    def state(self) -> JobState:
        record = self.folder / RECORD
        if not record.is_file() or json.loads(record.read_text()) != self.identity:
            return JobState.absent
        if (self.folder / SCORES).is_file():
            return JobState.done
        from hoigs.runs.checkpoint import latest_checkpoint

        try:
            latest_checkpoint(self.folder / "checkpoints")
        except CheckpointError:
            return JobState.absent
        return JobState.started

    def scores(self) -> dict[str, Any]:
        """The evaluation of a job that is done."""
        return json.loads((self.folder / SCORES).read_text())

    def dump(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        data: dict[str, Any] = json.loads(text)
        return cls(**(data | {k: tuple(v) for k, v in data.items() if isinstance(v, list)}))


def make_job(
    out: Path,
    clip: Path,
    clip_label: str,
    clip_digest: str,
    spec: str,
    settings: Sequence[str],
    *,
    kind: type[Job] = Job,
    **more: Any,
) -> Job:
    """A job in its own run folder under `out`: clip, spec and a piece of its hash.

    The hash covers seed, steps and all settings, so the same training is one job in every table,
    under whichever profile's name.

    Raises:
        SpecError: the spec cannot be used, or a setting would be a second seed.
    """
    if sum(setting.partition("=")[0].strip() == SEED for setting in settings) > 1:
        raise SpecError(
            f"{SEED}: the seeds of a study are 0, 1 … of --seeds; leave the setting out"
        )
    registry = default_registry([Path(p) for p in more.get("plugins", ())])
    loaded = Spec.load(spec, overrides=list(settings), registry=registry)
    name = f"{loaded.name.partition('@')[0]}-seed{loaded.train.seed}-{loaded.hash()[:8]}"
    run = out / "runs" / clip_label / name
    return kind(
        clip=str(clip),
        clip_label=clip_label,
        clip_digest=clip_digest,
        spec=spec,
        settings=tuple(settings),
        spec_hash=loaded.hash(),
        run=str(run),
        **more,
    )


def digest_folder(folder: Path) -> str:
    """SHA-256 of every file's path and content, in order."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def write_record(folder: Path, identity: Mapping[str, str]) -> None:
    """Mark a run folder as this job's."""
    write_whole(folder / RECORD, json.dumps(dict(identity)))


# The clips of a study: folder, label and digest of each.


class ClipFolders:
    """Folder, label and digest of each clip, found once."""

    def __init__(self) -> None:
        self.known: dict[str, tuple[Path, str, str]] = {}

    def get(self, clip: str) -> tuple[Path, str, str]:
        """Of a CLIP argument; a built-in clip is generated unless it is cached.

        Raises:
            ClipError: a clip that does not exist.
        """
        from hoigs.runs.clip_source import clip_folder, clip_name

        if clip not in self.known:
            folder = clip_folder(clip)
            if not folder.is_dir():
                raise ClipError(f"{clip}: no such clip folder; `hoigs prepare` makes one")
            folder = folder.resolve()
            self.known[clip] = (folder, clip_name(clip), digest_folder(folder))
        return self.known[clip]
