"""deformation:lbs: a body that is skinned and nothing else."""

from __future__ import annotations

from typing import Self

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.plugins.deformation.skinned_body import context_settings
from hoigs.plugins.deformation.surface_body import SurfaceBody


class LbsConfig(ComponentConfig):
    """Linear blend skinning by the template's weights.

    Attributes:
        refine_poses: learn per-frame corrections of pose and translation, and one of shape.
    """

    refine_poses: bool = True


class Lbs(SurfaceBody):
    """G(t) = LBS(P_c, theta(t), W) with the template's W; every rest field is trained."""

    recordable = True

    @classmethod
    def from_config(cls, config: LbsConfig, context: BuildContext) -> Self:
        settings = context_settings(context, "deformation:lbs")
        settings.pop("camera_centers", None)  # it scales about the pelvis
        assert context.body is not None
        return cls(context.body, **settings, **config.model_dump())

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        pose = self.moved_pose(moment, residual)
        change = self.shape_change(pose, moment)
        canonical = rest if change is None else rest.replace(means=rest.means + change)
        return self.posed(canonical, self.template_weights, pose, moment, residual)
