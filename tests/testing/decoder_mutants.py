"""A decoder that is right, and decoders with one mistake each."""

from __future__ import annotations

import itertools
from typing import ClassVar

import torch
from torch import nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.decoder import Decoder

# a counter instead of random numbers: two instances in a row always differ, deterministically
BUILT = itertools.count()


class RightConfig(ComponentConfig):
    pass


class Right(Decoder):
    """Correct: colours and a share of what channels, rays and the time say."""

    channels = 2

    def __init__(self) -> None:
        super().__init__()
        self.mix = nn.Linear(2 + 3 + 1, 3)

    def inputs(self, drawn, camera, moment):
        rays = camera.rays()
        time = torch.as_tensor(moment.time).to(rays).expand(*rays.shape[:2], 1)
        return torch.cat((self.seen(drawn), rays, time), -1)

    def seen(self, drawn):
        return drawn.features

    def share(self, drawn):
        return drawn.alpha[..., None]

    def forward(self, drawn, camera, moment):
        added = torch.sin(self.mix(self.inputs(drawn, camera, moment)))
        return drawn.color + self.share(drawn) * added


class FixedSize(Right):
    def forward(self, drawn, camera, moment):
        picture = super().forward(drawn, camera, moment)
        return picture if len(picture) > 1 else picture.expand(2, *picture.shape[1:])


class AlwaysDouble(Right):
    def forward(self, drawn, camera, moment):
        return super().forward(drawn, camera, moment).double()


class PaintsTheBackground(Right):
    def share(self, drawn):
        return 1.0


class CountsPixels(Right):
    def forward(self, drawn, camera, moment):
        picture = super().forward(drawn, camera, moment)
        rows = torch.arange(len(picture)).to(picture)[:, None, None]
        return picture + 0.01 * rows * self.share(drawn)


class Spare(Right):
    def __init__(self) -> None:
        super().__init__()
        self.spare = nn.Parameter(torch.zeros(3))


class HalfAGradient(Right):
    def seen(self, drawn):
        return drawn.features.detach() + 0.5 * (drawn.features - drawn.features.detach())


class UnsavedScale(Right):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", 1 + torch.rand(()), persistent=False)

    def share(self, drawn):
        return self.scale * super().share(drawn)


class OwnDice(Right):
    def __init__(self) -> None:
        super().__init__()
        self.mix.weight.data += 2e-8 * (next(BUILT) % 5)


class CopyIsItself(Right):
    def __deepcopy__(self, memo):
        return self


class RemembersTheTime(Right):
    last = 0.4

    def forward(self, drawn, camera, moment):
        time = float(moment.time)
        picture = super().forward(drawn, camera, moment)
        picture = picture + 1e-3 * (self.last != 0.4) * (time == 0.4) * self.share(drawn)
        self.last = time
        return picture


class WritesToDepth(Right):
    def forward(self, drawn, camera, moment):
        picture = super().forward(drawn, camera, moment)
        drawn.depth[0, 0] = -1.0
        return picture


class IgnoresOne(Right):
    def seen(self, drawn):
        return drawn.features * torch.tensor([1.0, 0.0]).to(drawn.features)


class NeedsANumber(Right):
    def forward(self, drawn, camera, moment):
        number = isinstance(moment.time, float)
        return super().forward(drawn, camera, moment) + 0.01 * (not number)


class UnknownRate(Right):
    rates: ClassVar = {"mix": "fast"}


MUTANTS = {
    "K01": FixedSize,
    "K02": AlwaysDouble,
    "K03": PaintsTheBackground,
    "K04": CountsPixels,
    "K05": Spare,
    "K06": HalfAGradient,
    "K07": UnsavedScale,
    "K08": OwnDice,
    "K09": CopyIsItself,
    "K10": RemembersTheTime,
    "K11": WritesToDepth,
    "K12": IgnoresOne,
    "K13": NeedsANumber,
    "K14": UnknownRate,
}
