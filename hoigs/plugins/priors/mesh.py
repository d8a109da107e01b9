"""prior:mesh: a template or generated mesh, sampled evenly and aligned to the clip.

As data sets with object templates have it (BEHAVE, ARCTIC) and as generators of meshes give it;
HOIGS, Sec. "Object Initialization", for scale and world transform (methods A.2).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

from pydantic import Field

from hoigs.core.clip import Clip, ObjectTrack
from hoigs.core.context import BuildContext
from hoigs.core.prior import ObjectPrior
from hoigs.plugins.priors.alignment import AlignmentConfig, align
from hoigs.plugins.priors.files import sample_mesh


class MeshPriorConfig(AlignmentConfig):
    """Settings of `prior:mesh`."""

    path: Path = Field(description="a .ply, .glb, .gltf, .obj, .off or .stl file with faces")
    count: int = Field(default=20_000, ge=4, description="points on its surface")
    scale_quantile: float = Field(default=0.0, ge=0, lt=0.5, description="a mesh has no strays")


class MeshPrior(ObjectPrior):
    """Points spread evenly over a mesh, coloured by its texture, vertices or faces.

    Args:
        path, count: as MeshPriorConfig describes them.
        alignment: axes, unit and place. seed: of the samples.

    Raises:
        HoigsError: at `initialise`, a file that is absent, damaged or no mesh.
    """

    def __init__(
        self,
        path: str | Path,
        count: int = 20_000,
        *,
        alignment: AlignmentConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.path, self.count = Path(path), count
        self.alignment, self.seed = alignment, seed

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(config.path, config.count, alignment=config, seed=context.seed)

    def initialise(self, clip: Clip, entity: str) -> ObjectTrack:
        points, colors = sample_mesh(self.path, self.count, self.seed)
        why = f"{self.count} points on the mesh {self.path.name}"
        return align(points, colors, clip, entity, self.alignment, provenance=why)
