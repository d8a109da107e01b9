"""Whether a gain is more than the same freedom brings where it is useless: a parametric bootstrap.

A richer model is ahead a little, or behind, on a scene that the simpler one describes completely.
How much that is depends on the clip, its masks, the length of a trial and the renderer, so no
number of dB can be right for long. Here it is measured: both are trained on what the trained
simpler model draws, with the errors that the richer one leaves in the same frame (a parametric
bootstrap with the residuals of the larger model, as for regressions in Davidson and MacKinnon 2004,
Econometric Theory and Methods, chapter 4). These errors keep their place and sign, so that what no
model can draw, such as detail beyond the renderer, is as it is in the video. Frame by frame, the
gain there is subtracted from the gain on the clip: a frame in which one of them is always better,
as its knots happen to lie, tells nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hoigs.core.values.clip import Clip, Frame, FrameStore, OverStore
from hoigs.studies.needs.search_space import (
    SCORING,
    Gain,
    Halving,
    StepBudget,
    differences,
    gain,
    mean_gain,
)
from hoigs.studies.needs.trial import Trial, region_of

BEYOND = 0.05  # share of what is useless that is taken for a gain
OBVIOUS = 3.0  # dB, half of the squared error: where all of that is gained, nothing is measured


class DrawnStore(OverStore):
    """Another store, with other images in some frames."""

    def __init__(self, base: FrameStore, images: dict[int, UInt8[Tensor, "H W 3"]]) -> None:
        super().__init__(base)
        self.images = images

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        return self.images[position] if position in self.images else self.base.image(position)


@torch.no_grad()
def as_if_true(simple: Trial, rich: Trial) -> Clip:
    """The clip of two trained trials as it would be if the simpler model were the truth.

    Its images, where the trials are scored, are what the simpler model draws plus the errors that
    the richer one leaves in the same frame.
    """
    view, images = simple.view, {}
    for position in sorted({p for split in view.split.values() for p in split}):
        frame = view[position]
        where = region_of(frame, view, simple.region, simple.names)
        found = (frame.rgb + _drawn(simple, frame) - _drawn(rich, frame)).clamp(0, 1)
        image = torch.where(where[..., None], found, frame.rgb)
        images[position] = (255 * image).round().to(torch.uint8)
    return replace(view, store=DrawnStore(view.store, images))


def _drawn(trial: Trial, frame: Frame) -> Float[Tensor, "H W 3"]:
    """What a trial's model draws over the pixels of the frame, 0 to 1."""
    model = trial.model
    training = model.training
    model.eval()
    output = model.render(frame.moment.to(model.device), frame.camera.to(model.device))
    model.train(training)
    return output.color.cpu() + (1 - output.alpha.cpu())[..., None] * frame.rgb


@dataclass(frozen=True)
class Calibrated:
    """What a calibration chose.

    Attributes:
        chosen: index of the candidate. useless: gain of the best one where a cheaper one is the
            truth, by the cheaper one's index.
    """

    chosen: int
    useless: Mapping[int, Gain]


def calibrated(
    trials: Sequence[Trial],
    costs: Sequence[float],
    halving: Halving,
    steps: int,
    allowance: StepBudget,
    *,
    least: float,
    moves: bool = False,
    what: str = "",
) -> Calibrated:
    """The cheapest candidate that no finalist is ahead of by more than its freedom explains.

    Where the allowance does not reach for a calibration, a gain counts as it is.

    Args:
        trials: of each candidate, cheapest first. costs: of a step of each. halving: of the trials;
            scores of those that are trained on are added. steps: of the trials that reached its
            end, the finalists. allowance: entered before each training, as `what`. least: dB of
            gain that are ignored in any case. moves: the clip's track says that the object moves; a
            model that stands still contradicts it, and is taken only if it is as good.
    """
    from scipy import stats  # on use: it takes a while to import

    finalists = [k for k, scores in enumerate(halving.scores) if steps in scores]
    finalists.sort(key=lambda k: halving.scores[k][steps].mean, reverse=True)
    best = finalists[0]
    useless: dict[int, Gain] = {}

    def is_ahead(rich: int, simple: int) -> bool:
        seen, own, top = halving.last_common(simple, rich)
        found, errors = gain(top, own), 1.0
        if found.mean - found.error > OBVIOUS:
            return True
        if moves and found.mean > least and _stands_still(trials[simple]):
            return True
        scoring = SCORING * len(own.psnr)
        price = costs[simple] * (steps - seen + scoring)
        price += (costs[simple] + costs[rich]) * (steps + scoring)
        if price <= allowance.left:
            allowance.spend(f"{what}[{rich}] where [{simple}] is the truth", price)
            own = halving.scores[simple][steps] = trials[simple].advance(steps)
            there = _useless(trials[simple], trials[rich], steps)
            useless.setdefault(simple, mean_gain(there))
            here = differences(halving.scores[rich][steps], own)
            found = mean_gain([gained - null for gained, null in zip(here, there, strict=True)])
            errors = stats.t.ppf(1 - BEYOND, len(there) - 1)  # 2.9 of three frames, 2.0 of six
        return found.mean > max(errors * found.error, least)

    for k in range(best):
        if not any(is_ahead(rich, k) for rich in finalists if k < rich <= best):
            return Calibrated(k, useless)
    return Calibrated(best, useless)


def _stands_still(trial: Trial) -> bool:
    return not any(trial.model.entity(name).deformation.moves for name in trial.names)


def _useless(simple: Trial, rich: Trial, steps: int) -> list[float]:
    """What the rich one gains in each frame where the simple one is the truth, dB."""
    view = as_if_true(simple, rich)
    cheap, dear = (trial.on(view).advance(steps) for trial in (simple, rich))
    return differences(dear, cheap)
