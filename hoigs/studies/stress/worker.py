"""One stressed training in a process of its own, as `hoigs.studies.worker` runs plain ones."""

from __future__ import annotations

import json
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.studies.cost import train_measured
from hoigs.studies.job import SCORES, JobState, write_record
from hoigs.studies.stress.job import StressJob
from hoigs.studies.stress.measures import STRESS
from hoigs.studies.worker import main


def run_job(job: StressJob, runs_at_once: int = 1) -> None:
    """Train and judge; times of rendering are not measured.

    Raises:
        HoigsError: the spec does not fit the clip, or the training failed.
    """
    from hoigs.evaluation.evaluate import evaluate
    from hoigs.studies.stress.observe import observe
    from hoigs.training.session import LoadedRun, Session, read_clip

    state = job.state()
    if state is JobState.done:
        return
    plugins = [Path(p) for p in job.plugins]
    session = Session.open(
        Path(job.clip),
        job.spec,
        out=job.folder,
        overrides=job.settings,
        device=job.device,
        resume=state is JobState.started,
        overwrite=state is JobState.absent,
        plugins=plugins,
        allow_faults=job.allow_faults,
    )
    if session.spec.hash() != job.spec_hash:
        raise HoigsError(f"{job.spec} has changed since the study was begun; start them again")
    write_record(job.folder, job.identity)
    train_measured(session, job, runs_at_once)
    loaded = LoadedRun.open(job.folder, clip=job.clip, device=job.device, plugins=plugins)
    clip = loaded.clip
    if job.judge:
        clip = read_clip(Path(job.judge), width=loaded.spec.train.width)
    evaluation = evaluate(loaded.model, clip, held_out=True, timing_frames=0)
    found = evaluation.to_dict() | {STRESS: observe(loaded.model, clip, evaluation.geometry)}
    temporary = job.folder / f".{SCORES}.part"
    temporary.write_text(json.dumps(found, indent=1, allow_nan=False))
    temporary.replace(job.folder / SCORES)


if __name__ == "__main__":
    main(StressJob, run_job)
