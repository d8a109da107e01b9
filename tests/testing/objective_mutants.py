"""An objective that is right, and objectives with one mistake each."""

from __future__ import annotations

import torch

from hoigs.core.config import ComponentConfig
from hoigs.core.model.objective import Objective


class RightConfig(ComponentConfig):
    power: float = 2.0


class Right(Objective):
    """The colour of the human's pixels, and the drawn heights, are small."""

    Config = RightConfig

    def __init__(self, config=None):
        self.config = config or RightConfig()

    def channels(self, at):
        return at.state.joined().means[:, 1:2]

    def terms(self, at, drawn, channels):
        mask = at.frame.masks.get("human")
        found = {"height": channels.abs().pow(self.config.power).mean()}
        if mask is not None and mask.any():
            found["dark"] = drawn.color[mask].square().mean()
        return found


class BelowZero(Right):
    def terms(self, at, drawn, channels):
        return {name: value - 1e3 for name, value in super().terms(at, drawn, channels).items()}


class Constant(Right):
    def terms(self, at, drawn, channels):
        return {n: x.detach() for n, x in super().terms(at, drawn, channels).items()}


class Counts(Right):
    calls = 0

    def terms(self, at, drawn, channels):
        type(self).calls += 1
        found = super().terms(at, drawn, channels)
        return {name: value * (1 + 0.1 * self.calls) for name, value in found.items()}


class DrawsRandomNumbers(Right):
    def terms(self, at, drawn, channels):
        torch.rand(1)
        return super().terms(at, drawn, channels)


class DividesByTheMask(Right):
    def terms(self, at, drawn, channels):
        found = super().terms(at, drawn, channels)
        share = sum(mask.sum() for mask in at.frame.masks.values())
        return found | {"share": found["height"] / share}


class NeedsTheObject(Right):
    def terms(self, at, drawn, channels):
        low = at.state.gaussians["object"].means[:, 1].square().mean()
        return super().terms(at, drawn, channels) | {"low": low}


MUTANTS = {
    "L01": BelowZero,
    "L02": Constant,
    "L03": Counts,
    "L04": DrawsRandomNumbers,
    "L05": DividesByTheMask,
    "L06": NeedsTheObject,
}
