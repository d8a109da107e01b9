"""`hoigs train --budget 20m`: image width and steps by what this machine does in that time."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from hoigs.core.errors import HoigsError, SpecError
from hoigs.core.model.compose import compose, compose_density, compose_objectives
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.evaluation.report.sections import clock
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import choose_reader, clip_folder, read_clip, require_folder
from hoigs.runs.resuming import DEFAULT_SPEC, NO_CLIP
from hoigs.training.options import TrainOptions
from hoigs.training.session import lpips_term
from hoigs.training.trainer import Trainer

WIDTHS = (128, 192, 256, 384, 512, 640, 960, 1280, 1920)
ENOUGH = 1500  # steps, before more pixels are worth more than more steps
MOST = 30_000
LEAST = 100
GROWTH = 1.25  # of a step's time, by what density control adds
REPORT = 12.0  # seconds of scoring that do not depend on the frames
FRAME = 2.0  # time of scoring a frame, in steps
PROBES = (128, 256)  # widths at which steps are timed
WARM, TIMED = 3, 5  # steps; on CUDA four times as many
_NUMBER = r"(\d+(?:\.\d+)?)"
_TIME = re.compile(f"(?:{_NUMBER}h)?(?:{_NUMBER}m)?(?:{_NUMBER}s?)?")


def seconds_of(text: str | float) -> float:
    """Seconds of "90s", "20m", "2h", "1h30m", or of a number of seconds.

    Raises:
        SpecError: it is neither, or nothing.
    """
    found = _TIME.fullmatch(str(text).strip())
    parts = [float(part or 0) for part in found.groups()] if found else [0.0, 0.0, 0.0]
    total = 3600 * parts[0] + 60 * parts[1] + parts[2]
    if total == 0:
        raise SpecError(f"--budget {text!r} is not a time; give 90s, 20m, 2h or 1h30m")
    return total


@dataclass(frozen=True)
class StepTime:
    """Seconds of a training step, linear in the image's pixels."""

    least: float
    per_pixel: float

    def at(self, pixels: float) -> float:
        return self.least + self.per_pixel * pixels

    @classmethod
    def through(cls, few: tuple[float, float], many: tuple[float, float]) -> StepTime:
        """The line through two measured (pixels, seconds); level where the larger was quicker."""
        slope = max(0.0, (many[1] - few[1]) / (many[0] - few[0])) if many[0] > few[0] else 0.0
        return cls(max(0.0, few[1] - slope * few[0]), slope)


@dataclass(frozen=True)
class BudgetPlan:
    """What a time is spent on.

    Attributes:
        width, height: of the images, pixels. step_s: expected time of a step.
        training_s, scoring_s: expected. limit_s: the given time. spent_s: of it, by measuring.
    """

    width: int
    height: int
    steps: int
    step_s: float
    training_s: float
    scoring_s: float
    limit_s: float
    spent_s: float = 0.0

    def sentence(self) -> str:
        total = self.spent_s + self.training_s + self.scoring_s
        return (
            f"budget {clock(self.limit_s)}: {self.steps} steps at {self.width}x{self.height}, "
            f"about {1000 * self.step_s:.0f} ms each on this machine; expected: training "
            f"{clock(self.training_s)}, scores {clock(self.scoring_s)}, {clock(total)} in all"
        )


def choose(
    native: tuple[int, int], scored: int, limit_s: float, step: StepTime, spent_s: float = 0.0
) -> BudgetPlan:
    """The widest images of which ENOUGH steps fit, and as many steps as fit then.

    Args:
        native: width and height of the clip's images. scored: frames that are scored.

    Raises:
        SpecError: not even LEAST steps of the smallest images fit.
    """
    width, height = native
    plans = []
    for wide in (*(w for w in WIDTHS if w < width), width):
        tall = round(height * wide / width)
        each = GROWTH * step.at(wide * tall)
        scoring = REPORT + FRAME * step.at(wide * tall) * scored
        steps = min(MOST, int((0.95 * limit_s - spent_s - scoring) / each))
        plans.append(BudgetPlan(wide, tall, steps, each, steps * each, scoring, limit_s, spent_s))
    least = plans[0]
    if least.steps < LEAST:
        needed = (spent_s + least.scoring_s + LEAST * least.step_s) / 0.95
        raise SpecError(
            f"--budget {clock(limit_s)} is too short: {LEAST} steps at {least.width} pixels of "
            f"width, and their scores, take {clock(needed)} on this machine"
        )
    return next((plan for plan in reversed(plans) if plan.steps >= ENOUGH), least)


def plan_budget(
    clip: Path | str | None,
    options: TrainOptions,
    now: Callable[[], float] = time.perf_counter,
) -> tuple[Spec, BudgetPlan]:
    """The spec with `train.width` and `train.steps` for a time, by steps timed on this machine.

    Raises:
        HoigsError: the input is wrong, sets width or steps itself, or the time is too short.
    """
    if options.resume:
        raise HoigsError("--budget plans a new run; a resumed one keeps its width and steps")
    limit, began = seconds_of(options.budget or ""), now()
    if clip is None:
        raise HoigsError(NO_CLIP)
    settings = options.spec_settings()
    for setting in settings:
        if setting.split("=")[0].strip() in ("train.steps", "train.width"):
            raise SpecError(f"--budget chooses width and steps: leave out {setting!r}")
    registry = default_registry(plugin_files=options.plugins)
    device, spec = pick_device(options.device), options.spec
    if not isinstance(spec, Spec):
        spec = Spec.load(spec or DEFAULT_SPEC, overrides=settings, registry=registry)
    folder = clip_folder(clip, registry)
    require_folder(folder)
    choice = choose_reader(folder, registry, options.reader, options.reader_settings)
    source = read_clip(folder, registry, allow_faults=options.allow_faults, reader=choice)
    native = source.cameras[0].width, source.cameras[0].height
    few, many = (
        _timed(_with(spec, min(width, native[0])), source, registry, device, now)
        for width in PROBES
    )
    held = 0 if source.held_out is None else len(source.held_out.split["test"])
    scored = len(source.split["test"]) + held
    found = choose(native, scored, limit, StepTime.through(few, many), now() - began)
    return _with(spec, found.width, found.steps), found


def _with(spec: Spec, width: int, steps: int | None = None) -> Spec:
    update = {"width": width} | ({} if steps is None else {"steps": steps})
    return spec.model_copy(update={"train": spec.train.model_copy(update=update)})


def _timed(
    spec: Spec, source: Clip, registry: Registry, device: str, now: Callable[[], float]
) -> tuple[float, float]:
    """Pixels of an image at the spec's width, and the seconds of a step in mid-training."""
    width = spec.train.width or source.cameras[0].width
    clip = source if width >= source.cameras[0].width else source.resized(width)
    torch.manual_seed(spec.train.seed)
    density = compose_density(spec, clip, registry)
    settings = spec.train.model_copy(
        update={"preview_every": 0, "fill_unseen": (), "steps": MOST, "passes": None}
    )
    trainer = Trainer(
        compose(spec, clip, registry).to(device),
        clip,
        settings,
        density=density,
        objectives=compose_objectives(spec, clip, registry),
        lpips=lpips_term(spec, None, device),
    )
    trainer.step = MOST // 2 + 1  # everything is warmed up, and density control is over
    times = 4 if device.startswith("cuda") else 1
    trainer.train(until=trainer.step + WARM * times)  # compiles kernels and captures graphs
    began = now()
    trainer.train(until=trainer.step + TIMED * times)
    camera = clip.cameras[0]
    return camera.width * camera.height, (now() - began) / (TIMED * times)
