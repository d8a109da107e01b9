"""prior:points: the points of any generator or of MASt3R, aligned to the clip.

HOIGS, Sec. "Object Initialization", takes canonical points from a generator, scales them by S and
puts them into the world; which generator that is stays open here (methods A.2, A.11).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import Field

from hoigs.core.clip import Clip, ObjectTrack
from hoigs.core.context import BuildContext
from hoigs.core.prior import ObjectPrior
from hoigs.plugins.priors.alignment import AlignmentConfig, align
from hoigs.plugins.priors.files import read_points
from hoigs.plugins.priors.outliers import inliers


class PointsPriorConfig(AlignmentConfig):
    """Settings of `prior:points`."""

    path: Path = Field(description="a .ply, .glb, .gltf, .obj, .xyz, .off or .stl file")
    min_opacity: float = Field(
        default=0.05, gt=0, lt=1, description="fainter Gaussians of a 3DGS .ply are left out"
    )
    outliers: float | None = Field(
        default=None, gt=1, description="take lonely points out, as prior:depth does; null: none"
    )


class PointsPrior(ObjectPrior):
    """Points of a file, aligned by the scale S and the world transform.

    Args:
        path, min_opacity, outliers: as PointsPriorConfig describes them.
        alignment: axes, unit and place.

    Raises:
        HoigsError: at `initialise`, a file that is absent, damaged, empty or not finite.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        min_opacity: float = 0.05,
        outliers: float | None = None,
        alignment: AlignmentConfig | None = None,
    ) -> None:
        self.path, self.min_opacity = Path(path), min_opacity
        self.outliers, self.alignment = outliers, alignment

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(
            config.path,
            min_opacity=config.min_opacity,
            outliers=config.outliers,
            alignment=config,
        )

    def initialise(self, clip: Clip, entity: str) -> ObjectTrack:
        points, colors = read_points(self.path, self.min_opacity)
        if self.outliers is not None:
            kept = inliers(points, ratio=self.outliers)
            points, colors = points[kept], colors[kept]
        why = f"points of {self.path.name}"
        return align(points, colors, clip, entity, self.alignment, provenance=why)
