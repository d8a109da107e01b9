"""Cost of a training, in `study.json` of the run folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoigs.core.files.whole_files import write_whole
from hoigs.evaluation.protocol import NotComputed, Value, from_json, to_json
from hoigs.studies.jobs.energy import EnergyMeter, energy_meter, spent
from hoigs.studies.jobs.job import Job
from hoigs.studies.jobs.machine import Machine
from hoigs.studies.jobs.memory import peak_memory, start_peak

if TYPE_CHECKING:
    from hoigs.training.session import Session

STUDY = "study.json"
OLD = "this run was made before costs were kept; delete its folder to train it again"
INTERRUPTED = "the training was interrupted, and what its lost part took is not known"
NO_MEMORY = "this run was made before peak memory was kept; delete its folder to train it again"


@dataclass(frozen=True)
class Cost:
    """Of one training.

    Attributes:
        train_s: seconds of all steps, checkpoints on the way included, previews and scoring not.
        joules: from the first step to the last, previews included. source: what they measure.
        memory_mb: peak in MB, of the GPU where there is one; previews included.
        memory_source: what that measures.
        machines: fingerprint of each; more than one if the run was moved.
        runs_at_once: how many runs shared the machine, this one included.
    """

    train_s: Value
    joules: Value
    source: str
    memory_mb: Value
    memory_source: str
    machines: tuple[str, ...]
    runs_at_once: int


def train_measured(session: Session, job: Job, runs_at_once: int = 1) -> None:
    """Train to the end, and write the cost.

    The start of each part is written first, so that an interrupted part is known to be missing.
    """
    trainer, path = session.trainer, job.folder / STUDY
    parts = [p for p in read_study(job.folder)["parts"] if p["from_step"] < trainer.step]
    record: dict[str, Any] = {"job": json.loads(job.dump()), "parts": parts}
    if trainer.step < session.spec.train.steps:
        part: dict[str, Any] = {
            "from_step": trainer.step,
            "machine": Machine.here(job.device).to_dict(),
            "runs_at_once": runs_at_once,
        }
        parts.append(part)
        _write(path, record)
        start_peak(job.device)
        meter = energy_meter(job.device)
        session.train(lambda _: meter.sample() if isinstance(meter, EnergyMeter) else None)
        joules = spent(meter)
        part["to_step"] = trainer.step
        part["joules"] = to_json(joules)
        part["source"] = meter.source if isinstance(meter, EnergyMeter) else ""
        memory, part["memory_source"] = peak_memory(job.device)
        part["memory_mb"] = to_json(memory)
    record["train_s"] = trainer.elapsed
    _write(path, record)


def read_study(folder: Path) -> dict[str, Any]:
    """`study.json` of a run; without parts where there is none."""
    path = folder / STUDY
    found: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {"parts": []}
    return found


def read_cost(folder: Path) -> Cost:
    """Cost of a trained run; a number that is absent has its reason."""
    study = read_study(folder)
    parts = study["parts"]
    if "train_s" not in study:
        return Cost(NotComputed(OLD), NotComputed(OLD), "", NotComputed(OLD), "", (), 1)
    joules: Value
    if len(parts) != 1 or "joules" not in parts[0]:
        joules = NotComputed(INTERRUPTED)
    else:
        joules = from_json(parts[0]["joules"])
    return Cost(
        train_s=float(study["train_s"]),
        joules=joules,
        source=parts[-1].get("source", "") if parts else "",
        memory_mb=_most(parts) if parts else NotComputed(NO_MEMORY),
        memory_source=parts[-1].get("memory_source", "") if parts else "",
        machines=tuple(dict.fromkeys(Machine(**p["machine"]).words for p in parts)),
        runs_at_once=max((p["runs_at_once"] for p in parts), default=1),
    )


def _most(parts: Sequence[Mapping[str, Any]]) -> Value:
    """The highest peak of all parts."""
    unknown = to_json(NotComputed(NO_MEMORY))
    values = [from_json(part.get("memory_mb", unknown)) for part in parts]
    reasons = [v for v in values if isinstance(v, NotComputed)]
    if reasons:
        return NotComputed(INTERRUPTED) if len(parts) > 1 else reasons[0]
    return max(v for v in values if not isinstance(v, NotComputed))


def _write(path: Path, record: dict[str, Any]) -> None:
    write_whole(path, json.dumps(record, indent=1, allow_nan=False))
