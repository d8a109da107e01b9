"""demo: the built-in clip reconstructed, scored, and compared with a static model."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from hoigs.core.options import verb
from hoigs.core.reporting import Progress
from hoigs.core.system.files import named
from hoigs.core.system.random_state import callers_random_state
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.metrics.ssim import ssim
from hoigs.rasterizers.warp.rasterizer import WarpRasterizer
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import clip_folder
from hoigs.runs.run_folder import RunFolder
from hoigs.training.options import DemoOptions, TrainOptions
from hoigs.training.train import OnStart, OnStep, Report, TrainedRun, silent, train

STEPS = 800
CLIP = "builtin:lift-and-swing"
FAST_STEPS = 200
FAST_CLIP = f"{CLIP}?width=128&frames=32&test_frames=8&held_out_views=4"
FAST_POINTS = {
    "hoigs": (
        "model.scene.points=6000",
        "model.scene.density.cap=6000",
        "model.human.points=3500",
        "model.object.points=1000",
    ),
    "static": ("model.scene.points=10500",),
}


@verb(DemoOptions)
@callers_random_state()
def demo(
    *,
    options: DemoOptions,
    on_start: OnStart | None = None,
    on_step: OnStep | None = None,
    progress: Progress | None = None,
    report: Report = silent,
) -> dict[str, TrainedRun]:
    """Generate a clip with known truth, reconstruct it, and write report.html.

    With `fast` half the frames, at half the width, and a third of the Gaussians; its scores are not
    those of the whole demo.

    Args:
        on_start, on_step, progress, report: as for `train`.

    Returns:
        The runs by the name of their spec, "hoigs" first.

    Raises:
        HoigsError: a folder exists already, or an option is wrong.
    """
    folders = {"hoigs": named(Path(options.out))}
    if not options.fast if options.baseline is None else options.baseline:
        folders["static"] = folders["hoigs"].with_name(f"{folders['hoigs'].name}-static")
    for folder in folders.values():  # check both before training for minutes
        RunFolder(folder).refuse_existing(options.overwrite)
    steps = options.steps
    if steps is None:
        steps = FAST_STEPS if options.fast else STEPS
    if options.fast:
        report(
            f"fast: 32 frames of 128x128, {steps} steps, a small model; without --fast the demo is "
            "larger, better and compared with a static model"
        )
    with ThreadPoolExecutor(1) as other_core:
        if pick_device(options.device) == "cpu" and options.rasterizer in (None, "warp"):
            other_core.submit(_compile_kernels)
        clip = clip_folder(FAST_CLIP if options.fast else CLIP)
    runs = {}
    for spec, folder in folders.items():
        points = FAST_POINTS[spec] if options.fast else ()
        overrides = (f"train.steps={steps}", *points, *options.overrides)
        chosen = options.part(TrainOptions).changed(spec=spec, out=folder, overrides=overrides)
        runs[spec] = train(
            clip, options=chosen, on_start=on_start, on_step=on_step, progress=progress,
            report=report,
        )  # fmt: skip
    return runs


def _compile_kernels() -> None:
    """Draws a few Gaussians: the first picture on a machine compiles the kernels of training.

    An error here is none of the demo's: training meets it again, and says it.
    """
    gaussians = Gaussians.from_points(torch.rand(4, 3), scales=0.1)
    camera = Camera.look_at(torch.full((3,), 3.0), torch.zeros(3), width=16, height=16, fov_y=1.0)
    sh = gaussians.sh.requires_grad_()
    color = WarpRasterizer().render(gaussians.replace(sh=sh), camera).color
    ssim(color, torch.zeros_like(color), backend="warp").backward()
