"""Interactions with one mistake each."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import ClassVar

import torch
from torch import nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import Residual

# a counter instead of random numbers: two instances in a row always differ, deterministically
BUILT = itertools.count()


class RightConfig(ComponentConfig):
    pass


class Right(InteractionModule):
    """Correct: sums over pairs, weighted by how far the object's centre is within reach."""

    tokens: ClassVar = {"object": "gaussian"}

    def __init__(self) -> None:
        super().__init__()
        self.to_pose = nn.Linear(4, 153, bias=False)
        self.to_means = nn.Linear(4, 3, bias=False)
        self.from_human = nn.Linear(6, 3, bias=False)

    @torch.no_grad()
    def gate(self, role, item):
        if len(item.positions) == 0:
            return item.positions.new_zeros(())
        apart = (role.anchors[0] - item.positions.mean(0)).norm()
        return (role.reach - apart).clamp_min(0)

    def summed(self, features):
        return features.sum(0)

    def pose(self, gate, item):
        return gate * self.to_pose(self.summed(item.features)).reshape(51, 3)

    def means(self, gate, human, item):
        return gate * (self.to_means(item.features) + self.from_human(human.features.mean(0)))

    def forward(self, tokens, roles):
        humans = [n for n in tokens if roles[n].kind == "human"]
        things = [n for n in tokens if roles[n].kind == "object"]
        if not humans or not things:
            return {}
        gates = {(h, o): self.gate(roles[h], tokens[o]) for h in humans for o in things}
        found = {}
        for h in humans:
            found[h] = Residual(pose=sum(self.pose(gates[h, o], tokens[o]) for o in things))
        for o in things:
            each = [self.means(gates[h, o], tokens[h], tokens[o]) for h in humans]
            found[o] = Residual(means=sum(each))
        return self.amend(found, tokens, roles, gates)

    def amend(self, found, tokens, roles, gates):
        return found

    def on_poses(self, found, change):
        return {
            n: r if r.pose is None else replace(r, pose=change(n, r.pose)) for n, r in found.items()
        }


class MovesPeople(Right):
    def amend(self, found, tokens, roles, gates):
        return {
            n: r if r.pose is None else replace(r, means=0 * r.pose[:3]) for n, r in found.items()
        }


class AlwaysDouble(Right):
    def amend(self, found, tokens, roles, gates):
        return self.on_poses(found, lambda n, pose: pose.double())


class RestlessAlone(Right):
    def amend(self, found, tokens, roles, gates):
        lonely = 0.01 * (sum(gates.values()) == 0)
        return self.on_poses(found, lambda n, pose: pose + lonely)


class RootOfNothing(Right):
    def pose(self, gate, item):
        root = torch.sqrt(gate + 0.0 * item.features.sum())
        return root * super().pose(1.0, item)


class MeanOfAll(Right):
    def amend(self, found, tokens, roles, gates):
        things = sum(r.means is not None for r in found.values())
        return self.on_poses(found, lambda n, pose: pose / things)


class FirstComesFirst(Right):
    def amend(self, found, tokens, roles, gates):
        first = next(iter(found))
        return self.on_poses(found, lambda n, pose: pose * (1.1 if n == first else 1.0))


class CountsTokens(Right):
    def means(self, gate, human, item):
        numbers = torch.arange(len(item.positions))[:, None].to(item.positions)
        return super().means(gate, human, item) + 0.01 * gate * numbers


class NeedsTokens(Right):
    def summed(self, features):
        features.amax(0)
        return super().summed(features)


class KnowsThePlace(Right):
    def amend(self, found, tokens, roles, gates):
        def shifted(name, pose):
            gate = sum(g for (h, _), g in gates.items() if h == name)
            return pose + 0.01 * gate * roles[name].anchors[0]

        return self.on_poses(found, shifted)


class Spare(Right):
    def __init__(self) -> None:
        super().__init__()
        self.spare = nn.Parameter(torch.zeros(3))


class HalfAGradient(Right):
    def summed(self, features):
        total = super().summed(features)
        return total.detach() + 0.5 * (total - total.detach())


class UnsavedScale(Right):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", 1 + torch.rand(()), persistent=False)

    def summed(self, features):
        return self.scale * super().summed(features)


class OwnDice(Right):
    def __init__(self) -> None:
        super().__init__()
        self.to_pose.weight.data += 2e-8 * (next(BUILT) % 5)


class RemembersCompany(Right):
    met = 0.0

    def amend(self, found, tokens, roles, gates):
        if len(tokens) == 2:
            self.met = 1e-3
        return self.on_poses(found, lambda n, pose: (1 + self.met) * pose)


class SpoilsTheFoot(Right):
    def amend(self, found, tokens, roles, gates):
        for role in roles.values():
            if role.anchors is not None:
                role.anchors[4] = 0.0
        return found


class OneForEachToken(Right):
    """Does not say that an object needs a token for each Gaussian."""

    tokens: ClassVar = {}


MUTANTS = {
    "I01": MovesPeople,
    "I02": AlwaysDouble,
    "I03": RestlessAlone,
    "I04": RootOfNothing,
    "I05": MeanOfAll,
    "I06": FirstComesFirst,
    "I07": CountsTokens,
    "I08": NeedsTokens,
    "I09": KnowsThePlace,
    "I10": Spare,
    "I11": HalfAGradient,
    "I12": UnsavedScale,
    "I13": OwnDice,
    "I14": RemembersCompany,
    "I15": SpoilsTheFoot,
}
