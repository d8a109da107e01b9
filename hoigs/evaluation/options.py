"""Options of `hoigs eval` (`hoigs.evaluate`) and of `hoigs.score`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from hoigs.core.options import Flag, Options
from hoigs.core.spec.train_schema import TestCamera, TestPoseSetting
from hoigs.evaluation.protocol import Pixels
from hoigs.runs.options import RunOptions


class EvaluateOptions(RunOptions):
    """How a run is scored."""

    lpips_weights: Path | str | None = None
    """File of LPIPS weights; default: the one that $HOIGS_LPIPS_WEIGHTS names, or else AlexNet's,
    which are shipped."""
    test_pose: str | None = None
    """Body poses of test frames: auto (blended if the clip's are estimates), given, interpolated
    (from training frames), blended (between both) or fitted (to the test images). Default: the
    spec's."""
    test_camera: str | None = None
    """Cameras of test frames: given, interpolated or fitted. Default: the spec's."""
    fit_steps: Annotated[int, Field(ge=1)] | None = None
    """Steps for each frame with fitted. Default: the spec's."""
    report: Annotated[bool, Flag("--report/--no-report")] = True
    """Write report.html."""

    def protocol(self) -> dict[str, str | int]:
        """What differs from the spec's block `evaluation`."""
        chosen = {name: getattr(self, name) for name in ("test_pose", "test_camera", "fit_steps")}
        return {name: value for name, value in chosen.items() if value is not None}


class ScoreOptions(Options):
    """How a model is scored on a clip."""

    split: str = "test"
    """The split of the clip."""
    lpips_weights: Path | str | None = None
    """As for `hoigs.evaluate`."""
    held_out: bool = True
    """Also score the clip's held-out cameras, where it has them."""
    test_pose: TestPoseSetting = "auto"
    """Source of body poses, see `posing.posed_clip`, and for "auto" `posing.source_of_poses`. The
    clip with these poses is `Evaluation.scored`."""
    test_camera: TestCamera = "given"
    """Source of the cameras of test frames."""
    fit_steps: int = 40
    """Optimizer steps of "fitted" for each frame."""
    pixels: Pixels = "float"
    """Score renders as they are, or rounded to 8 bits; both clamped to [0, 1]."""
    band: int | None = None
    """Width of the interaction band, pixels; default: 2 % of the longer side."""
    timing_frames: int = 100
    """Frames whose rendering is timed (`measure.render_time`); 0: none."""
    timing_warmup: int = 10
    """Frames that are rendered before."""
    timing_budget_s: float = 60.0
    """Seconds that timing may take."""
    device: str | None = None
    """Where to move the model to; default: it stays where it is."""
