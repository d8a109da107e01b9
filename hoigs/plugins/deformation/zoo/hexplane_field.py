"""deformation:hexplane-field: heads that read planes over space and time (4DGS, Wu et al. 2024,
arXiv:2310.08528; K-Planes, Fridovich-Keil et al. 2023, arXiv:2301.10241).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.feature_planes import ProductPlanes
from hoigs.core.values.gaussians import GaussianDelta, Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.fields import (
    DeltaHeads,
    Head,
    Turning,
    UnitBox,
    apply_delta,
    clamped_time,
    clip_length,
    half_the_frames,
    with_residual,
)


class HexPlaneFieldConfig(ComponentConfig):
    """4DGS's field in the sizes of its settings for real video (arguments/hypernerf)."""

    channels: int = Field(default=16, ge=1)
    """Channels of each plane."""
    resolution: int = Field(default=64, ge=2)
    """Cells along each space axis at the scale 1."""
    time_resolution: int | None = Field(default=150, ge=0)
    """Cells along time; None is half the clip's frames; 0 leaves the time planes out, and offsets
    are constant."""
    multires: tuple[int, ...] = (1, 2, 4)
    """Scales of the planes, as multiples of `resolution`."""
    width: int = Field(default=128, ge=8)
    """Width of the layers of the network that reads the planes."""
    depth: int = Field(default=1, ge=0)
    """Layers of that network before its heads; 0 is the same as 1."""
    heads: tuple[Head, ...] = ("means", "scales", "rotations")
    """Fields of the Gaussians that the network changes."""
    time_span: Literal["whole", "half"] = "whole"
    """"half" is 4DGS's code: time enters in [0, 1] where the planes span [-1, 1], so that half of
    each time plane is never read; "whole" reads all of it."""
    turning: Turning = "composed"
    """"added" adds quaternions as 4DGS does, "composed" rotates."""
    start: float = Field(default=0.0, ge=0, lt=1)
    """Share of the run in which nothing moves (4DGS: its first 3000 steps)."""


class HexPlaneField(DeformationModel):
    """Offsets of the fields in `heads` from the product of six planes at (x, y, z, t).

    Offsets are added in raw space. Means are not detached where the planes are read, as in 4DGS.
    The planes cover the bounding box of the Gaussians at the start; points outside read its border,
    so what is far away moves like the border (as in 4DGS). Times outside [0, 1] are those of the
    ends.

    Args:
        num_frames: frames in the clip; needed for a `time_resolution` of None.
    """

    Config: ClassVar = HexPlaneFieldConfig
    input_space: Literal["canonical", "world"] = "world"
    rates: ClassVar[Mapping[str, str]] = {"planes": "planes"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "plane_tv": 2e-4,
        "time_smoothness": 1e-3,
        "l1_time_planes": 1e-4,
    }

    def __init__(
        self, config: HexPlaneFieldConfig | None = None, *, num_frames: int | None = None
    ) -> None:
        super().__init__()
        self.config = config = config or HexPlaneFieldConfig()
        time_resolution = config.time_resolution
        if time_resolution is None:
            time_resolution = half_the_frames(num_frames)
        sizes = [config.resolution * scale for scale in config.multires]
        self.planes = ProductPlanes(config.channels, sizes, time_resolution)
        if config.time_span == "half":  # rows are then not where the times of the clip are
            self.planes.time_rows = {}
        self.box = UnitBox()

    @classmethod
    def from_config(cls, config: HexPlaneFieldConfig, context: BuildContext) -> Self:
        return cls(config, num_frames=clip_length(context))

    def bind(self, canonical: Gaussians) -> None:
        self.box.bind(canonical)
        bands = canonical.sh.shape[1]
        self.net = DeltaHeads(
            self.planes.width, self.config.width, self.config.depth, self.config.heads, bands
        )

    @property
    def still(self) -> bool:
        """Whether the run is in its static stage."""
        return self.progress < self.config.start

    def delta(self, means: Float[Tensor, "N 3"], time: float) -> GaussianDelta:
        """What is added at `time` to Gaussians whose canonical means are `means`, metres."""
        time = clamped_time(time)
        if self.config.time_span == "half":
            time = (1 + time) / 2
        return self.net(self.planes(self.box(means), time))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = canonical
        if not self.still:
            moved = apply_delta(
                canonical, self.delta(canonical.means, moment.time), turning=self.config.turning
            )
        return with_residual(moved, residual)

    def regularizers(self) -> dict[str, Tensor]:
        """4DGS's three penalties, each summed over planes and scales; none in the static stage.

        "plane_tv": `roughness` of the space planes; in spite of its name it is of second order and
        along one axis. "time_smoothness": of the time planes along time. "l1_time_planes": their
        mean distance from one.
        """
        if self.still:
            return {}
        count = 3 * len(self.planes.space)
        penalties = {"plane_tv": count * self.planes.space_smoothness()}
        if len(self.planes.time):
            penalties["time_smoothness"] = count * self.planes.time_smoothness()
            penalties["l1_time_planes"] = count * self.planes.time_sparsity()
        return penalties
