"""Choosing a candidate: the cheapest within one standard error of the best, or the least BIC."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, stdev
from typing import Literal

Criterion = Literal["one-se", "bic"]
CRITERIA: tuple[Criterion, ...] = ("one-se", "bic")
# pixels that count as one observation: a square of twice the radius of a small splat's blur
CORRELATED = (2 * 1.5) ** 2
MSE_FLOOR = 1e-10
PATIENCE = 1.5  # standard errors within which a candidate is kept before the last round


@dataclass(frozen=True)
class Score:
    """A candidate on the selection frames, in the region of its search space.

    Attributes:
        psnr: dB, one a frame; all candidates of a search space have the same frames.
        squares: summed squared error of a frame's region, mean over RGB. pixels: of the region.
        parameters: trained numbers of the trial's model.
    """

    psnr: tuple[float, ...]
    squares: tuple[float, ...]
    pixels: tuple[int, ...]
    parameters: int

    @property
    def mean(self) -> float:
        return mean(self.psnr)

    @property
    def mse(self) -> float:
        return sum(self.squares) / sum(self.pixels)


@dataclass(frozen=True)
class Gain:
    """Mean difference of two candidates over the same frames and its standard error, dB."""

    mean: float
    error: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} ± {self.error:.2f} dB"


def gain(of: Score, over: Score) -> Gain:
    """How much better `of` is than `over`, frame by frame.

    Raises:
        ValueError: fewer than two frames, or not the same number.
    """
    if len(of.psnr) != len(over.psnr) or len(of.psnr) < 2:
        raise ValueError(
            f"a paired standard error needs the same two or more frames: {len(of.psnr)} and "
            f"{len(over.psnr)}"
        )
    differences = [a - b for a, b in zip(of.psnr, over.psnr, strict=True)]
    return Gain(mean(differences), stdev(differences) / math.sqrt(len(differences)))


def bic(score: Score) -> float:
    """n log(MSE) + p log(n), with n the roughly independent pixels (Schwarz 1978)."""
    count = max(2.0, sum(score.pixels) / CORRELATED)
    return count * math.log(max(score.mse, MSE_FLOOR)) + score.parameters * math.log(count)


def near_best(
    scores: Sequence[Score], least: float = 0.0, min_gain: float = 0.0, errors: float = 1.0
) -> list[bool]:
    """Whether each score is as good as the best: within `errors` standard errors of the paired
    difference, within `least` dB, or within `min_gain` dB for every doubling of trained parameters
    up to those of the best."""
    best = max(scores, key=lambda score: score.mean)

    def tolerance(score: Score) -> float:
        larger = max(best.parameters, 1) / max(score.parameters, 1)
        return max(least, min_gain * math.log2(max(larger, 1.0)))

    gains = [gain(best, score) for score in scores]
    return [
        g.mean <= max(errors * g.error, tolerance(s)) for g, s in zip(gains, scores, strict=True)
    ]


def choose(
    scores: Sequence[Score],
    criterion: Criterion = "one-se",
    least: float = 0.0,
    min_gain: float = 0.0,
) -> int:
    """Index of the candidate to keep; scores are in order of cost."""
    if criterion == "bic":
        values = [bic(score) for score in scores]
        return values.index(min(values))
    return near_best(scores, least, min_gain).index(True)


def ranked(
    scores: Sequence[Score], criterion: Criterion, least: float, min_gain: float = 0.0
) -> list[int]:
    """Indices from the likeliest choice to the least likely: candidates that may be as good as the
    best by cost, then the others by score. The best itself is always among the first two.

    Early scores show which candidate learns fast rather than which is sufficient, so a candidate
    may be `PATIENCE` standard errors behind here, where the final choice allows one. With few
    frames that can be several dB, and without the place kept for the best, cheap candidates would
    exclude the one that they have to be compared with.
    """
    places = range(len(scores))
    if criterion == "bic":
        return sorted(places, key=lambda k: (bic(scores[k]), k))
    near = near_best(scores, least, min_gain, PATIENCE)
    order = sorted(places, key=lambda k: (not near[k], k if near[k] else -scores[k].mean))
    best = max(places, key=lambda k: scores[k].mean)
    if order.index(best) > 1:
        order.remove(best)
        order.insert(1, best)
    return order
