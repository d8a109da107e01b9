"""evaluate: the scores and the report of a run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.reporting import Progress
from hoigs.core.spec.train_schema import EvaluationSpec
from hoigs.core.system.folder_lock import FolderLock
from hoigs.core.system.random_state import callers_random_state
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.report import write_report
from hoigs.evaluation.scores import Evaluation
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.run_folder import RunFolder


@dataclass(frozen=True)
class EvaluatedRun:
    """The scores of a run, and the files in its folder.

    Attributes:
        scores: a JSON file. report: report.html, None if it was not written.
    """

    evaluation: Evaluation
    scores: Path
    report: Path | None


@callers_random_state()
def evaluate(
    run: Path | str,
    *,
    clip: Path | str | None = None,
    rasterizer: str | None = None,
    lpips_weights: Path | str | None = None,
    device: str = "auto",
    test_pose: str | None = None,
    test_camera: str | None = None,
    fit_steps: int | None = None,
    report: bool = True,
    plugins: Sequence[Path | str] = (),
    progress: Progress | None = None,
) -> EvaluatedRun:
    """Score a run on its test frames and held-out cameras; write evaluation.json and report.html.

    Under another `test_pose` or `test_camera` than the spec's, only the scores are written, as
    evaluation-POSE-CAMERA.json beside the run's own.

    Args:
        clip, rasterizer, device, plugins: as for `open_run`.
        lpips_weights: LPIPS weights; by default those that $HOIGS_LPIPS_WEIGHTS names, or
            AlexNet's, which are shipped.
        test_pose: body poses of test frames: "auto", "given", "interpolated" from training frames,
            "blended" from both, or "fitted" to the test images; by default the spec's.
            test_camera: "given", "interpolated" or "fitted".
        fit_steps: optimizer steps per "fitted" frame; by default the spec's.
        report: write report.html. progress: called with the share done, in [0, 1], and the work.

    Raises:
        HoigsError: this is no run, its clip is not there, the protocol is unknown, or another
            process writes the run.
    """
    run = Path(run)
    RunFolder(run).require()
    with FolderLock(run, "scoring") as lock:  # from reading the model until its scores are written
        loaded = LoadedRun.open(
            run, clip=clip, rasterizer=rasterizer, device=device, plugins=plugins
        )
        given = {"test_pose": test_pose, "test_camera": test_camera, "fit_steps": fit_steps}
        return _score(loaded, given, lpips_weights, report, lock, progress)


def _score(
    loaded: LoadedRun,
    given: Mapping[str, object],
    lpips_weights: Path | str | None,
    report: bool,
    lock: FolderLock,
    progress: Progress | None,
) -> EvaluatedRun:
    """The rest of `evaluate`, with the run folder locked; `given` changes the protocol."""
    run, settings = lock.folder, _protocol(loaded.spec.evaluation, given)
    evaluation = score(
        loaded.model, loaded.clip, lpips_weights=lpips_weights, held_out=settings.held_out,
        test_pose=settings.test_pose, test_camera=settings.test_camera,
        fit_steps=settings.fit_steps, progress=progress,
    )  # fmt: skip
    lock.require_held()
    if settings != loaded.spec.evaluation:
        scores = run / f"evaluation-{settings.test_pose}-{settings.test_camera}.json"
        evaluation.save(scores)
        return EvaluatedRun(evaluation, scores, None)
    scores, page = run / "evaluation.json", None
    evaluation.save(scores)
    if report:
        assert evaluation.scored is not None
        page = write_report(run, loaded.model, evaluation.scored, evaluation)
    return EvaluatedRun(evaluation, scores, page)


def _protocol(spec: EvaluationSpec, changes: Mapping[str, object]) -> EvaluationSpec:
    """The spec's evaluation settings with those `changes` that are not None.

    Raises:
        HoigsError: a value is not valid.
    """
    chosen = {name: value for name, value in changes.items() if value is not None}
    try:
        return type(spec).model_validate(spec.model_dump() | chosen)
    except ValidationError as error:
        wrong = error.errors()[0]
        value = str(wrong["input"])
        near = did_you_mean(value, ("auto", "given", "interpolated", "fitted"))
        raise HoigsError(f"{wrong['loc'][0]} {value}: {wrong['msg']}{near}") from error
