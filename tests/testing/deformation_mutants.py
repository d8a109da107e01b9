"""Deformations with one mistake each, by the check that must find it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.topology import reindex
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning, HexPlaneSkinningConfig
from hoigs.plugins.deformation.lbs import Lbs

# a counter instead of random numbers: two instances in a row always differ, deterministically
BUILT = itertools.count()


class RightConfig(ComponentConfig):
    size: float = 1.0


class Right(DeformationModel):
    """Correct: an offset for each Gaussian, and an oscillation of all."""

    owns = frozenset({"means"})
    per_gaussian = ("places",)
    rates = {"places": "means"}  # noqa: RUF012

    def __init__(self, size: float = 1.0) -> None:
        super().__init__()
        self.size = size
        self.sway = nn.Parameter(0.1 * torch.randn(3))

    def bind(self, canonical):
        self.places = nn.Parameter(canonical.means.clone())

    def moved(self, canonical, moment):
        return self.places + self.size * self.sway * torch.sin(self.sway.new_tensor(moment.time))

    def forward(self, canonical, moment, residual=None):
        means = self.moved(canonical, moment)
        if residual is not None and residual.means is not None:
            means = means + residual.means
        return canonical.replace(means=means)

    def on_topology(self, change):
        super().on_topology(change)
        self.places.data += change.offsets

    def regularizers(self):
        return {"sway": self.sway.square().sum()}


class GrowsItsSettings(Right):
    @classmethod
    def from_config(cls, config, context):
        config.size = 2.0
        return super().from_config(config, context)


class NeedsOneRow(Right):
    def moved(self, canonical, moment):
        return super().moved(canonical, moment) + 0.0 * self.places.amin()


class AlwaysDouble(Right):
    def moved(self, canonical, moment):
        return super().moved(canonical, moment).double()


class IgnoresPermutations(Right):
    def on_topology(self, change):
        if len(change) != len(self.places) or change.fresh.any():
            super().on_topology(change)


class RemembersTheWay(Right):
    last = -10.0
    back = False

    def moved(self, canonical, moment):
        self.back = self.back or moment.time < self.last
        self.last = moment.time
        return super().moved(canonical, moment) + 5e-5 * self.back


class NothingLater(Right):
    def moved(self, canonical, moment):
        return super().moved(canonical, moment) * (torch.nan if moment.time > 1.5 else 1.0)


class Spare(Right):
    def __init__(self, size: float = 1.0) -> None:
        super().__init__(size)
        self.spare = nn.Parameter(torch.zeros(3))


class HalfAGradient(Right):
    def moved(self, canonical, moment):
        means = super().moved(canonical, moment)
        return means.detach() + 0.5 * (means - means.detach())


class Jumps(Right):
    def moved(self, canonical, moment):
        return super().moved(canonical, moment) + 0.01 * (moment.time > 0.6)


class PrunesTheLast(Right):
    def on_topology(self, change):
        if len(change) < len(self.places):
            self.places.data = self.places.data[: len(change)]
        else:
            super().on_topology(change)


class ClonesTheFirst(Right):
    def on_topology(self, change):
        grows = len(change) > len(self.places) and not change.offsets.any()
        source = torch.where(change.fresh, 0, change.source) if grows else change.source
        super().on_topology(replace(change, source=source))


class ForgetsOffsets(Right):
    def on_topology(self, change):
        reindex([self.places], change)


class StaysWhenRelocated(Right):
    def on_topology(self, change):
        if len(change) != len(self.places) or not change.fresh.any():
            super().on_topology(change)


class UndeclaredRows(Right):
    per_gaussian = ()

    def on_topology(self, change):
        reindex([self.places], change)
        self.places.data += change.offsets


class StartIsNotSaved(Right):
    def bind(self, canonical):
        super().bind(canonical)
        self.register_buffer("start", canonical.means.detach().clone(), persistent=False)

    def moved(self, canonical, moment):
        return super().moved(canonical, moment) + 0.1 * self.start

    def on_topology(self, change):
        super().on_topology(change)
        self.start = self.start[change.source]


class OwnDice(Right):
    def __init__(self, size: float = 1.0) -> None:
        super().__init__(size)
        self.sway.data += 2e-8 * (next(BUILT) % 5)


class CopyIsItself(Right):
    def __deepcopy__(self, memo):
        return self


class StateOfWords(Right):
    def get_extra_state(self):
        return {"made by": "me"}

    def set_extra_state(self, state):
        pass


class SpoilsThePose(Right):
    def moved(self, canonical, moment):
        for pose in moment.poses.values():
            pose.betas.zero_()
        return super().moved(canonical, moment)


class Twice(Right):
    def forward(self, canonical, moment, residual=None):
        if residual is not None and residual.means is not None:
            residual = replace(residual, means=2 * residual.means)
        return super().forward(canonical, moment, residual)


class PoseSum(Right):
    factor = 0.01

    def forward(self, canonical, moment, residual=None):
        out = super().forward(canonical, moment, residual)
        if residual is None or residual.pose is None:
            return out
        return out.replace(means=out.means + self.factor * residual.pose.sum())


class HardlyPosed(PoseSum):
    residuals = frozenset({"means", "pose"})
    factor = 1e-6


class DeafToTheLoss(Right):
    def forward(self, canonical, moment, residual=None):
        if residual is not None and residual.means is not None:
            residual = replace(residual, means=residual.means.detach())
        return super().forward(canonical, moment, residual)


class SpreadOfOne(Right):
    def regularizers(self):
        return {"spread": self.places.std(0).mean()}


class NewParameter(Right):
    def evolve(self, canonical, statistics):
        if statistics.step == 500:
            self.sway = nn.Parameter(self.sway.detach().clone())
        return {}


class NothingAtFirst(Right):
    def moved(self, canonical, moment):
        share = torch.tensor(self.progress if self.training else 1.0)
        return super().moved(canonical, moment) + share.log() - share.log()


class Backwards(Right):
    provides = frozenset({"velocity"})

    def velocity(self, canonical, moment):
        slope = self.size * self.sway * torch.cos(self.sway.new_tensor(moment.time))
        return -slope.expand(len(canonical), 3)


class OnePart(HexPlaneSkinning):
    def field_parts(self):
        return torch.zeros_like(super().field_parts())


class FarAnchors(Lbs):
    def anchors(self, moment):
        return super().anchors(moment) + 2.0


class LongNormals(Lbs):
    def face_points(self):
        rows, normals = super().face_points()
        return rows, 2 * normals


class StrangeRate(Right):
    rates = {"places": "speed"}  # noqa: RUF012


class OneOpacity(Right):
    def __init__(self, size: float = 1.0) -> None:
        super().__init__(size)
        self.logit = nn.Parameter(torch.zeros(()))

    def forward(self, canonical, moment, residual=None):
        logits = self.logit + 0.0 * canonical.opacity_logits.detach()
        return super().forward(canonical, moment, residual).replace(opacity_logits=logits)


class KeepsPictures(Right):
    def forward(self, canonical, moment, residual=None):
        if self.training or torch.is_grad_enabled() or residual is not None:
            return super().forward(canonical, moment, residual)
        kept = self.__dict__.setdefault("kept", {})
        if moment.time not in kept:
            kept[moment.time] = super().forward(canonical, moment, residual)
        return kept[moment.time]


class OtherWithoutGradients(Right):
    def moved(self, canonical, moment):
        return super().moved(canonical, moment) + (0.0 if torch.is_grad_enabled() else 1e-4)


SMALL = HexPlaneSkinningConfig(resolution=8, channels=2, width=8, field_points=64)
CONFIGS: dict[str, Any] = {"D28": SMALL, "D29": Lbs.Config(), "D30": Lbs.Config()}
MUTANTS: dict[str, type[DeformationModel]] = {
    "D01": GrowsItsSettings,
    "D02": NeedsOneRow,
    "D03": AlwaysDouble,
    "D04": IgnoresPermutations,
    "D05": RemembersTheWay,
    "D06": NothingLater,
    "D07": Spare,
    "D08": HalfAGradient,
    "D09": Jumps,
    "D10": PrunesTheLast,
    "D11": ClonesTheFirst,
    "D12": ForgetsOffsets,
    "D13": StaysWhenRelocated,
    "D14": UndeclaredRows,
    "D15": StartIsNotSaved,
    "D16": OwnDice,
    "D17": CopyIsItself,
    "D18": StateOfWords,
    "D19": SpoilsThePose,
    "D20": Twice,
    "D21": HardlyPosed,
    "D22": PoseSum,
    "D23": DeafToTheLoss,
    "D24": SpreadOfOne,
    "D25": NewParameter,
    "D26": NothingAtFirst,
    "D27": Backwards,
    "D28": OnePart,
    "D29": FarAnchors,
    "D30": LongNormals,
    "D31": StrangeRate,
    "D32": OneOpacity,
    "D33": KeepsPictures,
    "D34": OtherWithoutGradients,
}
