"""Feature extractors with one mistake each."""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch
from torch import nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.values.tokens import Tokens
from hoigs.core.values.topology import reindex

# a counter instead of random numbers: two instances in a row always differ, deterministically
BUILT = itertools.count()


class RightConfig(ComponentConfig):
    pass


class Right(FeatureExtractor):
    """Correct: a code and the velocity of each Gaussian, at its mean."""

    requires = frozenset({"velocity"})
    per_gaussian = ("codes",)
    width = 5

    def __init__(self) -> None:
        super().__init__()
        self.mix = nn.Linear(7, 5)

    def bind(self, deformation, canonical):
        self.codes = nn.Parameter(torch.randn(len(canonical), 4))

    def forward(self, deformation, canonical, moment):
        velocity = deformation.velocity(canonical, moment)
        features = self.mix(torch.cat((velocity, self.codes), 1)) * (1 + moment.time)
        with torch.no_grad():
            positions = deformation(canonical, moment).means
        return self.amend(Tokens(features, positions), moment)

    def amend(self, tokens, moment):
        return tokens


class WrongWidth(Right):
    width = 6


class DoublePlaces(Right):
    def amend(self, tokens, moment):
        return replace(tokens, positions=tokens.positions.double())


class NothingBefore(Right):
    def amend(self, tokens, moment):
        return replace(tokens, features=tokens.features * (torch.nan if moment.time < -0.1 else 1))


class IgnoresPermutations(Right):
    def on_topology(self, change):
        if len(change) != len(self.codes) or change.fresh.any():
            super().on_topology(change)


class Spare(Right):
    def __init__(self) -> None:
        super().__init__()
        self.spare = nn.Parameter(torch.zeros(3))


class HalfAGradient(Right):
    def amend(self, tokens, moment):
        x = tokens.features
        return replace(tokens, features=x.detach() + 0.5 * (x - x.detach()))


class Elsewhere(Right):
    def amend(self, tokens, moment):
        return replace(tokens, positions=tokens.positions + 10.0)


class UndeclaredRows(Right):
    per_gaussian = ()

    def on_topology(self, change):
        reindex([self.codes], change)


class StartIsNotSaved(Right):
    def bind(self, deformation, canonical):
        super().bind(deformation, canonical)
        self.register_buffer("start", canonical.means.detach().clone(), persistent=False)

    def amend(self, tokens, moment):
        return replace(tokens, features=tokens.features + self.start.sum(1, keepdim=True))

    def on_topology(self, change):
        super().on_topology(change)
        self.start = self.start[change.source]


class OwnDice(Right):
    def __init__(self) -> None:
        super().__init__()
        self.mix.bias.data += 2e-8 * (next(BUILT) % 5)


class CopyIsItself(Right):
    def __deepcopy__(self, memo):
        return self


class RemembersTheWay(Right):
    last = -10.0
    back = False

    def amend(self, tokens, moment):
        self.back = self.back or moment.time < self.last
        self.last = moment.time
        return replace(tokens, features=tokens.features + 5e-5 * self.back)


class TakesFewOnly(Right):
    """One token a Gaussian, as it declares, up to ten."""

    tokens = "gaussian"

    def amend(self, tokens, moment):
        return Tokens(tokens.features[:10], tokens.positions[:10])


MUTANTS = {
    "F01": WrongWidth,
    "F02": DoublePlaces,
    "F03": NothingBefore,
    "F04": IgnoresPermutations,
    "F05": Spare,
    "F06": HalfAGradient,
    "F07": Elsewhere,
    "F08": UndeclaredRows,
    "F09": StartIsNotSaved,
    "F10": OwnDice,
    "F11": CopyIsItself,
    "F12": RemembersTheWay,
    "F13": TakesFewOnly,
}
