"""deformation:lbs: a body that is skinned and nothing else."""

from __future__ import annotations

from typing import ClassVar

from hoigs.core.maths.rotations import normalize_quats
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.skinned_body import SkinnedBodyConfig
from hoigs.plugins.deformation.surface_body import SurfaceBody


class Lbs(SurfaceBody):
    """G(t) = LBS(P_c, theta(t), W) with the body's own W; every canonical field is trained."""

    Config: ClassVar = SkinnedBodyConfig
    cuda_graph_safe = True

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        pose, vertices, joints = self.shaped_pose(moment, residual)
        change = self.shape_change(pose, vertices, moment)
        means = canonical.means if change is None else canonical.means + change
        shaped = canonical.replace(means=means, quats=normalize_quats(canonical.quats))
        return self.posed(shaped, self.template_weights, pose, joints, moment, residual)
