"""Bodies with one mistake each."""

from __future__ import annotations

from dataclasses import replace

import torch

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.body import BodyOutput
from hoigs.testing.material import TinyBody


class TinyConfig(ComponentConfig):
    pass


class LooseFinger(TinyBody):
    def __init__(self) -> None:
        super().__init__()
        self.parents = (*self.parents[:23], 20, *self.parents[24:])


class Mirrored(TinyBody):
    def __init__(self) -> None:
        super().__init__()
        flip = torch.tensor((-1.0, 1, 1))
        self.template, self.joints = self.template * flip, self.joints * flip


class AllPelvis(TinyBody):
    def __init__(self) -> None:
        super().__init__()
        self.vertex_parts = torch.zeros_like(self.vertex_parts)


class NegativeWeight(TinyBody):
    def __init__(self) -> None:
        super().__init__()
        self.skinning_weights[0, 0] += 0.1
        self.skinning_weights[0, 40] -= 0.1


class HoveringSurface(TinyBody):
    def surface(self, count=None, betas=None, seed=0):
        surface = super().surface(count, betas, seed)
        return replace(surface, points=surface.points + 0.01 * surface.normals)


class IdleBeta(TinyBody):
    num_betas = 3

    def shaped(self, betas):
        return super().shaped(betas[..., :2])


class GrowsWhenPosed(TinyBody):
    def forward(self, pose):
        output = super().forward(pose)
        root = output.joints[..., :1, :]
        return replace(output, vertices=root + 1.05 * (output.vertices - root))


class StepsTooFar(TinyBody):
    def skinning_transforms(self, pose):
        return super().skinning_transforms(pose.replace(transl=1.1 * pose.transl))


class OneElbow(TinyBody):
    def joint_rotations(self, pose):
        turns = super().joint_rotations(pose).clone()
        turns[..., 19, :] = turns[..., 18, :]
        return turns


class FirstOfABatch(TinyBody):
    def forward(self, pose):
        output = super().forward(pose)
        if pose.transl.dim() == 1:
            return output
        return replace(output, vertices=output.vertices[:1].expand_as(output.vertices))


class FixedShape(TinyBody):
    def shaped(self, betas):
        return super().shaped(betas.detach())


class AlwaysDouble(TinyBody):
    def forward(self, pose):
        output = super().forward(pose)
        return BodyOutput(output.vertices.double(), output.joints)


class NudgesTheHand(TinyBody):
    def forward(self, pose):
        if not pose.left_hand.requires_grad:
            pose.left_hand.add_(1e-6)
        return super().forward(pose)


MUTANTS = {
    "B01": LooseFinger,
    "B02": Mirrored,
    "B03": AllPelvis,
    "B04": NegativeWeight,
    "B05": HoveringSurface,
    "B06": IdleBeta,
    "B07": GrowsWhenPosed,
    "B08": StepsTooFar,
    "B09": OneElbow,
    "B10": FirstOfABatch,
    "B11": FixedShape,
    "B12": AlwaysDouble,
    "B13": NudgesTheHand,
}
