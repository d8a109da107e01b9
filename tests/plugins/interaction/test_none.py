"""Without interaction, nothing is computed for it."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.interaction.none import NoInteraction
from hoigs.rasterizers.torch_tiles import TorchRasterizer


class Asked(Exception):  # noqa: N818
    pass


class Walker(DeformationModel):
    """Says when somebody wants to know where it stands."""

    provides = frozenset({"skeleton"})
    entity = "human"

    def forward(self, canonical, moment, residual=None):
        assert residual is None
        return canonical

    def asked(self, *args):
        raise Asked

    pose = anchors = arm_length = point_parts = asked


class Curious(InteractionModule):
    def forward(self, tokens, roles):
        return {}


def test_roles_are_asked_for_only_where_they_are_read():
    canonical = Gaussians.from_points(torch.rand(4, 3))

    def scene(interaction: InteractionModule | None) -> SceneModel:
        human = Entity(canonical, Walker(), kind="human")
        return SceneModel({"human": human}, interaction=interaction, rasterizer=TorchRasterizer())

    for interaction in (None, NoInteraction()):
        assert scene(interaction)(Moment(0.5)).residuals == {}
    with pytest.raises(Asked):
        scene(Curious())(Moment(0.5))
