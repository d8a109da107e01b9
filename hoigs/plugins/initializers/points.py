"""initializer:points: the points of any generator or of MASt3R, aligned to the clip.

HOIGS, Sec. "Object Initialization", takes canonical points from a generator, scales them by S and
transforms them to the world. The generator is the user's choice.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from hoigs.core.interfaces.initializer import ObjectInitializer
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.plugins.initializers.alignment import AlignmentConfig, align
from hoigs.plugins.initializers.outliers import inliers
from hoigs.plugins.initializers.shape_files import read_points


class PointsInitializerConfig(AlignmentConfig):
    """Settings of `initializer:points`."""

    path: Path = Field(description="a .ply, .glb, .gltf, .obj, .xyz, .off or .stl file")
    min_opacity: float = Field(
        default=0.05, gt=0, lt=1, description="fainter Gaussians of a 3DGS .ply are left out"
    )
    outliers: float | None = Field(
        default=None,
        gt=1,
        description="remove outliers, as initializer:depth does; null keeps all",
    )


class PointsInitializer(ObjectInitializer):
    """Points of a file, aligned by the scale S and the world transform.

    Raises:
        HoigsError: at `initialize`, a file that is absent, damaged, empty or not finite.
    """

    Config: ClassVar = PointsInitializerConfig
    config: PointsInitializerConfig

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        points, colors = read_points(self.config.path, self.config.min_opacity)
        if self.config.outliers is not None:
            kept = inliers(points, ratio=self.config.outliers)
            points, colors = points[kept], colors[kept]
        why = f"points of {self.config.path.name}"
        return align(points, colors, clip, entity, self.config, provenance=why)
