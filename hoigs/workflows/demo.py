"""demo: the built-in clip reconstructed, scored, and compared with a static model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hoigs.core.progress import Progress
from hoigs.runs.clip_source import clip_folder
from hoigs.runs.run_folder import RunFolder
from hoigs.workflows.train import OnStart, OnStep, Report, TrainedRun, silent, train


def demo(
    *,
    out: Path | str = "runs/demo",
    steps: int = 800,
    overrides: Sequence[str] = (),
    rasterizer: str | None = None,
    device: str = "auto",
    baseline: bool = True,
    overwrite: bool = False,
    on_start: OnStart | None = None,
    on_step: OnStep | None = None,
    progress: Progress | None = None,
    report: Report = silent,
) -> dict[str, TrainedRun]:
    """Generate a clip with known truth, reconstruct it, and write report.html.

    Args:
        out: the run folder; that of the static model is OUT-static. steps: of each training.
        baseline: also train a static model, to compare with.
        overwrite: replace earlier runs in these folders.
        overrides, rasterizer, device, on_start, on_step, progress, report: as for `train`.

    Returns:
        The runs by the name of their spec, "hoigs" first.

    Raises:
        HoigsError: a folder exists already, or an option is wrong.
    """
    folders = {"hoigs": Path(out)}
    if baseline:
        folders["static"] = folders["hoigs"].with_name(f"{folders['hoigs'].name}-static")
    for folder in folders.values():  # check both before training for minutes
        RunFolder(folder).refuse_existing(overwrite)
    clip = clip_folder("builtin:lift-and-swing")
    return {
        spec: train(
            clip, spec, out=folder, overrides=[f"train.steps={steps}", *overrides],
            rasterizer=rasterizer, device=device, overwrite=overwrite, on_start=on_start,
            on_step=on_step, progress=progress, report=report,
        )
        for spec, folder in folders.items()
    }  # fmt: skip
