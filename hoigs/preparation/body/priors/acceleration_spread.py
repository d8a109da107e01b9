"""How strongly each point of a body accelerates in a clip, estimated from noisy places of it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

AT_ONCE = 256  # accelerations that are decorrelated together
FEWEST = 16  # accelerations that an estimate needs
RATIOS = torch.logspace(0.5, 5, 46, dtype=torch.float64)  # of accelerations to noise, 1/s^2
SLOWEST, FASTEST = 3.0, 60.0  # m/s^2: a throw after a long rest is not held still
JITTERY, JITTER = 1.5, 16.0  # of the points' median noise; least acceleration from there on, m/s^2


def acceleration_spreads(
    places: Float[Tensor, "F K C"],
    known: Bool[Tensor, "F K"],
    factors: Float[Tensor, "T 3"],
    otherwise: Float[Tensor, " K"],
) -> Float[Tensor, " K"]:
    """Standard deviations of accelerations, a component, m/s^2.

    Second differences of places that were measured with white noise are accelerations plus noise
    of a known spectrum. The most probable ratio of the two is searched for, and the noise follows
    (restricted maximum likelihood, Patterson and Thompson 1971). A point that jitters more than
    most may be measured worse, or jolted; it is not held stiller than `JITTER`.

    Args:
        places: metres. factors: of three places that give their second derivative, 1/s^2.
        otherwise: of points that are known in too few frames.
    """
    spreads = otherwise.clone()
    noise = torch.full_like(spreads, torch.nan)
    alike, group = torch.unique(known, dim=1, return_inverse=True)
    for number, frames in enumerate(alike.T):  # one decomposition for points of the same frames
        points = (group == number).nonzero()[:, 0]
        by_noise, squares = _spectrum(places[:, points], frames, factors)
        if len(by_noise) < FEWEST:
            continue
        for point, column in zip(points.tolist(), squares.T, strict=True):
            if column.any():
                spreads[point], noise[point] = _most_probable(by_noise, column)
    spreads = spreads.clamp(SLOWEST, FASTEST)
    jittery = noise > JITTERY * noise.nanmedian()
    return torch.where(jittery, spreads.clamp_min(JITTER), spreads)


def _spectrum(
    places: Float[Tensor, "F K C"], known: Bool[Tensor, " F"], factors: Float[Tensor, "T 3"]
) -> tuple[Float[Tensor, " M"], Float[Tensor, "M K"]]:
    """Of uncorrelated sums of second differences: the variance that noise of one metre gives them,
    and their mean squares."""
    noise, squares = [places.new_zeros(0)], [places.new_zeros(0, places.shape[1])]
    whole = known.unfold(0, 3, 1).all(-1)
    for start in range(0, len(factors), AT_ONCE):
        rows = whole[start : start + AT_ONCE].nonzero()[:, 0]
        window = slice(start, start + AT_ONCE + 2)
        onto = places.new_zeros(len(rows), len(places[window]))
        for k in range(3):
            onto[torch.arange(len(rows)), rows + k] = factors[start + rows, k]
        values, vectors = torch.linalg.eigh(onto @ onto.mT)
        sums = vectors.mT @ onto @ places[window].nan_to_num().flatten(1)
        noise.append(values.clamp_min(0))
        squares.append(sums.square().unflatten(1, places.shape[1:]).mean(-1))
    return torch.cat(noise), torch.cat(squares)


def _most_probable(
    noise: Float[Tensor, " M"], squares: Float[Tensor, " M"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Standard deviations of accelerations and of noise."""
    spread = RATIOS[:, None].square() + noise
    variance = (squares / spread).mean(-1)  # of the noise, at each ratio
    best = (variance.log() + spread.log().mean(-1)).argmin()
    deviation = variance[best].sqrt()
    return RATIOS[best] * deviation, deviation
