"""evaluate: the scores and the report of a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.options import verb
from hoigs.core.reporting import Progress
from hoigs.core.spec.train_schema import EvaluationSpec
from hoigs.core.system.folder_lock import FolderLock
from hoigs.core.system.random_state import callers_random_state
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.options import EvaluateOptions, ScoreOptions
from hoigs.evaluation.report import write_report
from hoigs.evaluation.scores import Evaluation
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

    def _repr_html_(self) -> str:
        return self.evaluation._repr_html_()


@verb(EvaluateOptions)
@callers_random_state()
def evaluate(
    run: Path | str, *, options: EvaluateOptions, progress: Progress | None = None
) -> EvaluatedRun:
    """Score a run on its test frames and held-out cameras; write evaluation.json and report.html.

    Under another `test_pose` or `test_camera` than the spec's, only the scores are written, as
    evaluation-POSE-CAMERA.json beside the run's own.

    Args:
        run: a run folder, as `hoigs.train` makes it.
        progress: called with the share done, in [0, 1], and the work.

    Raises:
        HoigsError: this is no run, its clip is not there, the protocol is unknown, or another
            process writes the run.
    """
    run = Path(run)
    RunFolder(run).require()
    with FolderLock(run, "scoring") as lock:  # from reading the model until its scores are written
        loaded = options.open(run)
        settings = _protocol(loaded.spec.evaluation, options.protocol())
        wanted = ScoreOptions(**settings.model_dump(), lpips_weights=options.lpips_weights)
        evaluation = score(loaded.model, loaded.clip, options=wanted, progress=progress)
        lock.require_held()
        own = settings == loaded.spec.evaluation
        protocol = "" if own else f"-{settings.test_pose}-{settings.test_camera}"
        scores, page = run / f"evaluation{protocol}.json", None
        evaluation.save(scores)
        if own and options.report:
            assert evaluation.scored is not None
            page = write_report(run, loaded.model, evaluation.scored, evaluation)
        return EvaluatedRun(evaluation, scores, page)


def _protocol(spec: EvaluationSpec, changes: Mapping[str, object]) -> EvaluationSpec:
    """The spec's evaluation settings with `changes`.

    Raises:
        HoigsError: a value is not valid.
    """
    try:
        return type(spec).model_validate(spec.model_dump() | dict(changes))
    except ValidationError as error:
        wrong = error.errors()[0]
        value = str(wrong["input"])
        near = did_you_mean(value, ("auto", "given", "interpolated", "fitted"))
        raise HoigsError(f"{wrong['loc'][0]} {value}: {wrong['msg']}{near}") from error
