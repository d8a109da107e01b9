"""Train one cell of a chart again, from its stored spec and seed, and compare the numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.chart.data import AXES
from hoigs.studies.chart.run import measured
from hoigs.studies.execution.executor import Executor
from hoigs.studies.jobs.cost import read_study
from hoigs.studies.jobs.job import Job, digest_folder, make_job
from hoigs.studies.jobs.run_jobs import run_jobs

TOLERANCE_DB = 0.05


@dataclass(frozen=True)
class Rerun:
    """A cell's numbers, first and again.

    Attributes:
        same_machine: whether one machine measured both; numbers are compared only then.
    """

    run: Path
    first: Mapping[str, Value]
    again: Mapping[str, Value]
    machines: tuple[str, str]

    @property
    def same_machine(self) -> bool:
        return self.machines[0] == self.machines[1]

    def difference(self, name: str) -> float | None:
        """Again minus first; None where either has no number."""
        a, b = self.first[name], self.again[name]
        return None if isinstance(a, NotComputed) or isinstance(b, NotComputed) else b - a

    @property
    def reproduced(self) -> bool:
        """Whether every PSNR is within 0.05 dB; a number that one lacks is not reproduced."""
        for name in (n for n in AXES if n.startswith("psnr")):
            if isinstance(self.first[name], NotComputed) != isinstance(
                self.again[name], NotComputed
            ):
                return False
            difference = self.difference(name)
            if difference is not None and abs(difference) > TOLERANCE_DB:
                return False
        return True


def rerun(out: Path, cell: str, executor: Executor | None = None) -> Rerun:
    """Train and score a cell once more, below `out`/reruns; the first run is left as it is.

    Args:
        out: folder of the chart. cell: "CLIP/RUN" as the chart's files name it, or its folder.
        executor: where it runs; default this machine.

    Raises:
        HoigsError: there is no such cell, its clip has changed, or it failed this time.
    """
    folder = find_cell(out, cell)
    job = Job.parse(json.dumps(read_study(folder)["job"]))
    clip = Path(job.clip)
    if not clip.is_dir() or digest_folder(clip) != job.clip_digest:
        raise HoigsError(f"{clip}: the clip of {cell} is not there or no longer the same")
    count = 1 + len(list((out / "reruns").glob(f"*/runs/{job.clip_label}/{folder.name}")))
    again = make_job(
        out / "reruns" / str(count), clip, job.clip_label, job.clip_digest,
        str(folder / "spec.yaml"), (), device=job.device, lpips_weights=job.lpips_weights,
        plugins=job.plugins,
    )  # fmt: skip
    failed = run_jobs([again], executor)
    if failed:
        raise HoigsError(f"{cell} failed this time: {failed[again.run]}")
    first, second = measured(replace(job, run=str(folder))), measured(again)
    return Rerun(
        again.folder, first["values"], second["values"], (first["machine"], second["machine"])
    )


def find_cell(out: Path, cell: str) -> Path:
    """The run folder of a cell.

    Raises:
        HoigsError: there is none, or it is not done.
    """
    runs = out / "runs"
    known = [str(p.parent.relative_to(runs)) for p in sorted(runs.glob("*/*/evaluation.json"))]
    for folder in (runs / cell, out / cell, Path(cell)):
        if (folder / "evaluation.json").is_file() and "job" in read_study(folder):
            return folder.resolve()
    raise HoigsError(
        f"{out}: no finished cell {cell!r}; there are {', '.join(known) or 'none'}"
        f"{did_you_mean(cell, known)}"
    )
