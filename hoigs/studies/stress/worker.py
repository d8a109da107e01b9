"""The module that a StressJob's process runs: `hoigs.studies.stress.worker JOB RUNS_AT_ONCE`."""

from __future__ import annotations

import json
from pathlib import Path

from hoigs.core.system.files import write_whole
from hoigs.studies.jobs.job import SCORES
from hoigs.studies.jobs.worker import main, train_job
from hoigs.studies.stress.measures import STRESS, observe
from hoigs.studies.stress.run import StressJob


def run_job(job: StressJob, runs_at_once: int = 1) -> None:
    """Train and score; times of rendering are not measured."""
    from hoigs.evaluation.evaluate import score
    from hoigs.runs.clip_source import read_clip

    loaded = train_job(job, runs_at_once, allow_faults=job.allow_faults)
    if loaded is None:
        return
    clip = loaded.clip
    if job.scoring_clip:
        clip = read_clip(Path(job.scoring_clip), width=loaded.spec.train.width)
    evaluation = score(loaded.model, clip, held_out=True, timing_frames=0)
    found = evaluation.to_dict() | {STRESS: observe(loaded.model, clip, evaluation.geometry)}
    write_whole(job.folder / SCORES, json.dumps(found, indent=1, allow_nan=False))


if __name__ == "__main__":
    main(StressJob, run_job)
