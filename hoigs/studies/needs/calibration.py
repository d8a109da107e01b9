"""Whether a gain is more than the same freedom brings where it is useless: a parametric bootstrap.

A richer model is ahead a little, or behind, on a scene that the simpler one describes completely.
How much that is depends on the clip, its masks, the length of a trial and the renderer, so no
number of dB can be right for long. Here it is measured: both are trained on what the trained
simpler model draws, with that model's own errors under a random sign for every frame (the wild
bootstrap, Wu 1986), and once more with the opposite signs, so that what the signs bring cancels
(antithetic: Hammersley and Morton 1956). Frame by frame, the mean gain there is subtracted from the
gain on the clip (Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter 16): a frame
in which one of them is always better, as its knots happen to lie, tells nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.values.clip import Clip, FrameStore
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

ERRORS = 2.0  # standard errors: with six frames, 5 % of what is useless is more (Student)
OBVIOUS = 3.0  # dB, half of the squared error: where all of that is gained, nothing is measured


class DrawnStore(FrameStore):
    """Another store, with other images in some frames."""

    def __init__(self, base: FrameStore, images: dict[int, UInt8[Tensor, "H W 3"]]) -> None:
        self.base, self.images = base, images
        self.root = base.root

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        return self.images[position] if position in self.images else self.base.image(position)

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        return self.base.mask(entity, position)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        return self.base.depth(position)

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        return self.base.ignored(position)

    def mask_known(self, entity: str, position: int) -> bool:
        return self.base.mask_known(entity, position)


@torch.no_grad()
def as_if_true(trial: Trial, flip: bool = False, seed: int = 0) -> Clip:
    """The view of a trial with images in which its model is the truth, where the trial is scored.

    Args:
        trial: trained. flip: turns all signs of its errors. seed: of these signs.
    """
    generator = torch.Generator().manual_seed(seed)
    model, view = trial.model, trial.view
    training = model.training
    model.eval()
    images = {}
    for position in sorted({p for split in view.split.values() for p in split}):
        frame = view[position]
        where = region_of(frame, view, trial.region, trial.names)
        output = model.render(frame.moment.to(model.device), frame.camera.to(model.device))
        behind = (1 - output.alpha.cpu())[..., None] * frame.rgb
        drawn = output.color.cpu() + behind
        sign = 1.0 if (torch.rand((), generator=generator) < 0.5) != flip else -1.0
        found = (drawn + sign * (frame.rgb - drawn)).clamp(0, 1)
        image = torch.where(where[..., None], found, frame.rgb)
        images[position] = (255 * image).round().to(torch.uint8)
    model.train(training)
    return replace(view, store=DrawnStore(view.store, images))


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
    """The cheapest candidate that the best is not ahead of by more than its freedom explains.

    Where the allowance does not reach for a calibration, a gain counts as it is.

    Args:
        trials: of each candidate, cheapest first. costs: of a step of each. halving: of the trials;
            scores of those that are trained on are added. steps: of the trials that reached its
            end. allowance: entered before each training, as `what`. least: dB of gain that are
            ignored in any case. moves: the clip's track says that the object moves; a model that
            stands still contradicts it, and is taken only if it is as good.
    """
    finalists = [k for k, scores in enumerate(halving.scores) if steps in scores]
    best = max(finalists, key=lambda k: halving.scores[k][steps].mean)
    useless: dict[int, Gain] = {}
    for k in range(best):
        seen, own, top = halving.last_common(k, best)
        found, errors = gain(top, own), 1.0
        if found.mean - found.error > OBVIOUS:
            continue
        if moves and found.mean > least and _stands_still(trials[k]):
            continue
        scoring = SCORING * len(own.psnr)
        pair = (costs[k] + costs[best]) * (steps + scoring)
        price = costs[k] * (steps - seen + scoring) + 2 * pair
        if price <= allowance.left:
            allowance.spend(f"{what}[{best}] where [{k}] is the truth", price)
            own = halving.scores[k][steps] = trials[k].advance(steps)
            null = _useless(trials[k], trials[best], steps)
            useless[k] = mean_gain(null)
            real = differences(halving.scores[best][steps], own)
            found = mean_gain([gained - there for gained, there in zip(real, null, strict=True)])
            errors = ERRORS
        if found.mean <= max(errors * found.error, least):
            return Calibrated(k, useless)
    return Calibrated(best, useless)


def _stands_still(trial: Trial) -> bool:
    return not any(trial.model.entity(name).deformation.moves for name in trial.names)


def _useless(simple: Trial, rich: Trial, steps: int) -> list[float]:
    """What the rich one gains in each frame where the simple one is the truth, dB."""
    gains = []
    for flip in (False, True):
        view = as_if_true(simple, flip)
        cheap, dear = (trial.on(view).advance(steps) for trial in (simple, rich))
        gains.append(differences(dear, cheap))
    return [mean(both) for both in zip(*gains, strict=True)]
