"""Options of `hoigs train`, `demo` and `refine`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from hoigs.core.options import Flag, Options
from hoigs.core.spec.schema import Spec
from hoigs.runs.choices import with_rasterizer
from hoigs.runs.options import ModelOptions

Overrides = Annotated[tuple[str, ...], Flag("--set")]


class FitOptions(ModelOptions):
    """Of everything that trains a model."""

    overrides: Overrides = ()
    """Set one key of the spec: train.steps=500."""
    overwrite: bool = False
    """Replace what hoigs wrote to --out before."""

    def spec_settings(self) -> list[str]:
        """All that is laid over the spec."""
        return with_rasterizer(self.overrides, self.rasterizer)


class TrainOptions(FitOptions):
    """How a model is fitted to a clip."""

    spec: str | Path | Spec | None = None
    """A built-in spec's name or a file; @PROFILE may follow. Default: hoigs; with --resume the
    run's."""
    out: Path | str | None = None
    """Run folder; default: runs/CLIP-SPEC."""
    resume: bool = False
    """Continue the run in --out, with its own spec and clip unless others are given."""
    allow_faults: bool = False
    """Continue without masks, images and depth that are missing or broken."""
    reader: str | None = None
    """Reader of the dataset layout of CLIP; default: the one that recognises it."""
    reader_settings: Annotated[tuple[str, ...], Flag("--reader-set")] = ()
    """A setting of the reader: masks=false."""
    budget: str | float | None = None
    """A time, 90s, 20m or 2h: width and steps are chosen so that training and scores take about
    that long on this machine."""
    chunk: int | None = None
    """For a long clip, to save memory: train in windows of this many frames, of which one is in
    memory at a time. Short windows, of 16 frames, cost the least time."""
    evaluate: Annotated[bool, Flag("--eval/--no-eval")] = True
    """Score the run and write its report."""
    view: bool = False
    """Show the training in the browser while it lasts."""
    port: int = 8090
    """Port of --view, on this machine; 0 finds a free one."""
    lpips_weights: Path | str | None = None
    """File of LPIPS weights, for the loss and the scores; default: the one that
    $HOIGS_LPIPS_WEIGHTS names, or else AlexNet's, which are shipped."""

    def spec_settings(self) -> list[str]:
        chunk = () if self.chunk is None else (f"train.chunk={self.chunk}",)
        return with_rasterizer((*self.overrides, *chunk), self.rasterizer)


class DemoOptions(FitOptions):
    """How the built-in clip is reconstructed."""

    out: Path | str = "runs/demo"
    """Run folder; that of the static model is OUT-static."""
    fast: bool = False
    """A first look in half a minute: smaller, less sharp."""
    steps: int | None = None
    """Training steps of each model; default: 800, with --fast 200."""
    baseline: Annotated[bool | None, Flag("--baseline/--no-baseline")] = None
    """Also train a static model for comparison; by default not with --fast."""


class RefineOptions(Options):
    """How the body poses of a clip are corrected."""

    steps: Annotated[int, Field(ge=1)] | None = None
    """Steps of the training; default: 12.5 a frame, from 800 to 2000."""
    # landmarks are off by one or two pixels of a larger picture
    width: Annotated[int, Field(ge=16)] = 256
    """Width of the images that are compared, pixels."""
    overrides: Overrides = ()
    """Set one key of the spec: train.steps=500."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda if available."""
    overwrite: bool = False
    """Replace what hoigs wrote to --out before."""
