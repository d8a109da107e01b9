"""initializer:mesh: a template or generated mesh, sampled evenly and aligned to the clip.

Data sets with object templates (BEHAVE, ARCTIC) and generators of meshes provide one. Scale and
world transform follow HOIGS, Sec. "Object Initialization".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import Field

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.initializer import ObjectInitializer
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.plugins.initializers.alignment import AlignmentConfig, align
from hoigs.plugins.initializers.shape_files import sample_mesh


class MeshInitializerConfig(AlignmentConfig):
    """Settings of `initializer:mesh`."""

    path: Path = Field(description="a .ply, .glb, .gltf, .obj, .off or .stl file with faces")
    count: int = Field(default=20_000, ge=4, description="number of points on its surface")
    scale_quantile: float = Field(default=0.0, ge=0, lt=0.5, description="a mesh has no strays")


class MeshInitializer(ObjectInitializer):
    """Points spread evenly over a mesh, coloured by its texture, vertices or faces.

    Raises:
        HoigsError: at `initialize`, a file that is absent, damaged or no mesh.
    """

    Config: ClassVar = MeshInitializerConfig
    config: MeshInitializerConfig

    def __init__(self, config: MeshInitializerConfig, *, seed: int = 0) -> None:
        super().__init__(config)
        self.seed = seed

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(config, seed=context.seed)

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        path, count = self.config.path, self.config.count
        points, colors = sample_mesh(path, count, self.seed)
        why = f"{count} points on the mesh {path.name}"
        return align(points, colors, clip, entity, self.config, provenance=why)
