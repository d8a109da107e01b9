"""deformation:hexplane-field: planes over space and time drive small heads (4DGS, Wu et al. 2024;
K-Planes, Fridovich-Keil et al. 2023; methods B.1, B.10)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import GaussianDelta, Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.planes import ProductPlanes
from hoigs.plugins.deformation.deltas import (
    DeltaHeads,
    Head,
    Turning,
    apply_delta,
    clamped_time,
    half_the_frames,
    with_residual,
)
from hoigs.plugins.deformation.encoding import UnitBox

TimeSpan = Literal["whole", "half"]


class HexPlaneFieldConfig(ComponentConfig):
    """4DGS's field in the sizes of its HyperNeRF setting, the one for real video (methods B.1).

    Attributes:
        channels, resolution, time_resolution, multires: of the planes; see ProductPlanes. A
            time_resolution of None is half the clip's frames; of 0, no time planes: offsets stay.
        width, depth: of the network behind them. heads: what it changes.
        time_span: "half" is 4DGS's code: time enters in [0, 1] where the planes span [-1, 1], so
            half of each time plane is never read; "whole" reads all of it.
        turning: "added" adds quaternions as 4DGS does, "composed" turns.
        start: share of the run in which nothing moves (4DGS: its first 3000 steps).
    """

    channels: int = Field(16, ge=1)
    resolution: int = Field(64, ge=2)
    time_resolution: int | None = Field(150, ge=0)
    multires: tuple[int, ...] = (1, 2, 4)
    width: int = Field(128, ge=8)
    depth: int = Field(1, ge=0)
    heads: tuple[Head, ...] = ("means", "scales", "rotations")
    time_span: TimeSpan = "whole"
    turning: Turning = "composed"
    start: float = Field(0.0, ge=0, lt=1)


class HexPlaneField(DeformationModel):
    """Offsets of the fields in `heads` from the product of six planes at (x, y, z, t).

    Offsets are added in raw space. Centres are not detached where the planes are read, as in
    4DGS. The planes cover the box of the Gaussians at the start; points that leave it read its
    border, so what is far behind moves as the edge does (4DGS, quirk 5). Times outside [0, 1] are
    held at the ends.

    Args: as HexPlaneFieldConfig.
    """

    rest_space: Literal["canonical", "world"] = "world"
    rates: ClassVar[Mapping[str, str]] = {"planes": "planes"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "plane_tv": 2e-4,
        "time_smoothness": 1e-3,
        "l1_time_planes": 1e-4,
    }

    def __init__(
        self,
        channels: int = 16,
        resolution: int = 64,
        time_resolution: int = 150,
        multires: Sequence[int] = (1, 2, 4),
        width: int = 128,
        depth: int = 1,
        heads: Sequence[Head] = ("means", "scales", "rotations"),
        time_span: TimeSpan = "whole",
        turning: Turning = "composed",
        start: float = 0.0,
    ) -> None:
        super().__init__()
        self.planes = ProductPlanes(channels, resolution, time_resolution, multires)
        self.width, self.depth, self.fields = width, depth, tuple(heads)
        self.time_span, self.turning, self.start = time_span, turning, start
        self.box = UnitBox()

    @classmethod
    def from_config(cls, config: HexPlaneFieldConfig, context: BuildContext) -> Self:
        settings = config.model_dump()
        if config.time_resolution is None:
            settings["time_resolution"] = half_the_frames(context)
        return cls(**settings)

    def bind(self, rest: Gaussians) -> None:
        self.box.bind(rest)
        bands = rest.sh.shape[1]
        self.net = DeltaHeads(self.planes.width, self.width, self.depth, self.fields, bands)

    @property
    def still(self) -> bool:
        """Whether the run is in its static stage."""
        return self.progress < self.start

    def delta(self, means: Float[Tensor, "N 3"], time: float) -> GaussianDelta:
        """What is added at `time` to Gaussians whose rest centres are `means`, metres."""
        time = clamped_time(time)
        clock = time if self.time_span == "half" else 2 * time - 1
        return self.net(self.planes(self.box(means), clock))

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = rest
        if not self.still:
            moved = apply_delta(rest, self.delta(rest.means, moment.time), turning=self.turning)
        return with_residual(moved, residual)

    def regularizers(self) -> dict[str, Tensor]:
        """ProductPlanes.smoothness; none in the static stage."""
        return {} if self.still else self.planes.smoothness()
