"""deformation:se3-field: a field of rigid motions from a code of time (Nerfies, Park et al. 2021;
HyperNeRF, Park et al. 2021) on Gaussians: canonical to world, where NeRFs warp the other way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import exp_se3, multiply_quats, normalize_quats, quats_to_matrices
from hoigs.plugins.deformation.deltas import clamped_time, with_residual
from hoigs.plugins.deformation.encoding import (
    SkipTrunk,
    TimeTable,
    UnitBox,
    encoded_width,
    positional_encoding,
)

ELASTIC_SCALE = 0.03  # of the robust loss, in logarithms of stretch (Nerfies)
DIFFERENCE = 2e-4  # box units, for derivatives: far below a wave of the highest octave


class Se3FieldConfig(ComponentConfig):
    """Nerfies' field (google/hypernerf: SE3Field), and HyperNeRF's slices.

    Attributes:
        code: width of the learned code of a trained frame; between frames they are interpolated.
        width, depth, skip: of the network; `skip` is the layer that takes the input again.
        frequencies: octaves of the position. window_until: share of the run over which they are
            let in one after the other, 0 for all at once.
        ambient: HyperNeRF's extra coordinates, a function of place and time that colour and
            opacity see; 0 is Nerfies. ambient_width, ambient_depth: of the network that gives
            them.
        elastic_points: Gaussians, drawn anew at each step, at which the elastic loss is taken.
    """

    code: int = Field(8, ge=1)
    width: int = Field(128, ge=8)
    depth: int = Field(6, ge=1)
    skip: int = Field(4, ge=1)
    frequencies: int = Field(8, ge=0)
    window_until: float = Field(0.32, ge=0, le=1)
    ambient: int = Field(0, ge=0, le=8)
    ambient_width: int = Field(64, ge=8)
    ambient_depth: int = Field(6, ge=1)
    elastic_points: int = Field(128, ge=1)


class Se3Field(DeformationModel):
    """x -> R(x, t) x + T(x, t), and each Gaussian turned by R; (R, T) = exp(MLP(PE(x), code(t))).

    Positions are read, and moved, in the box of the Gaussians at the start, scaled to [-1, 1] by
    its largest half-side. Centres are not detached. Times outside the trained ones are held.

    With `ambient`, a second network gives w(x, t), and colour and opacity gain what a third one
    makes of (x, w): what appears and vanishes need not be moved out of sight. That one starts at
    zero.

    Args:
        times: of the trained frames, in [0, 1], ascending.
        The others are Se3FieldConfig's.
    """

    rest_space: Literal["canonical", "world"] = "world"
    regularizer_weights: ClassVar[Mapping[str, float]] = {"elastic": 1e-3}

    def __init__(
        self,
        times: Sequence[float],
        *,
        code: int = 8,
        width: int = 128,
        depth: int = 6,
        skip: int = 4,
        frequencies: int = 8,
        window_until: float = 0.32,
        ambient: int = 0,
        ambient_width: int = 64,
        ambient_depth: int = 6,
        elastic_points: int = 128,
    ) -> None:
        super().__init__()
        self.frequencies, self.window_until = frequencies, window_until
        self.elastic_points, self.ambient = elastic_points, ambient
        self.codes = TimeTable(code, times)
        self.box = UnitBox()
        place = encoded_width(3, frequencies)
        self.trunk = SkipTrunk(place + code, width, depth, skip)
        self.screw = nn.Linear(width, 6)
        glorot(self.trunk)
        near_zero(self.screw, 1e-4)
        if ambient:
            self.slicer = SkipTrunk(place + code, ambient_width, ambient_depth, skip)
            self.coordinates = nn.Linear(ambient_width, ambient)
            glorot(self.slicer)
            near_zero(self.coordinates, 1e-2)
            self.looks = nn.Sequential(
                nn.Linear(place + encoded_width(ambient, 1), width),
                nn.ReLU(),
                nn.Linear(width, 1 + 3),
            )
            glorot(self.looks)
            last = self.looks[-1]
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        self._seen: tuple[Float[Tensor, "S 3"], float] | None = None

    @classmethod
    def from_config(cls, config: Se3FieldConfig, context: BuildContext) -> Self:
        settings: dict[str, Any] = config.model_dump()
        clip = context.clip
        if clip is None:
            raise ValueError("deformation:se3-field needs a clip: it has a code per trained frame")
        train = clip.split.get("train", range(len(clip)))
        return cls(sorted({clip.moments[i].time for i in train}), **settings)

    def bind(self, rest: Gaussians) -> None:
        self.box.bind(rest)
        middle = (self.box.low + self.box.high) / 2
        half = (self.box.high - self.box.low).amax() / 2  # one scale, or R would shear
        self.box.low, self.box.high = middle - half, middle + half

    @property
    def window(self) -> float | None:
        """Octaves let in at this point of the run; None is all."""
        if self.window_until == 0 or self.progress >= self.window_until:
            return None
        return self.frequencies * self.progress / self.window_until

    def motion(
        self, points: Float[Tensor, "N 3"], time: float
    ) -> tuple[Float[Tensor, "N 4"], Float[Tensor, "N 3"]]:
        """Quaternions and translations, in box units, at points of the box."""
        screw = self.screw(self.trunk(self._entry(points, time)))
        return exp_se3(screw[:, :3], screw[:, 3:])

    def warp(self, points: Float[Tensor, "N 3"], time: float) -> Float[Tensor, "N 3"]:
        """Where the field takes points of the box at `time`, box units."""
        quats, shifts = self.motion(points, time)
        return (quats_to_matrices(quats) @ points[..., None]).squeeze(-1) + shifts

    def _entry(self, points: Float[Tensor, "N 3"], time: float) -> Float[Tensor, "N E"]:
        place = positional_encoding(points, self.frequencies, self.window)
        return torch.cat((place, self.codes(clamped_time(time)).expand(len(points), -1)), dim=1)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        points = self.box(rest.means)
        quats, shifts = self.motion(points, moment.time)
        moved = (quats_to_matrices(quats) @ points[..., None]).squeeze(-1) + shifts
        half = (self.box.high - self.box.low) / 2
        out = replace(
            rest,
            means=rest.means + (moved - points) * half,
            quats=multiply_quats(quats, normalize_quats(rest.quats)),
        )
        if self.ambient:
            out = self._sliced(out, points, moment.time)
        if self.training and torch.is_grad_enabled() and len(rest):
            rows = torch.randint(len(rest), (self.elastic_points,)).to(points.device)
            self._seen = (points.detach()[rows], moment.time)
        return with_residual(out, residual)

    def _sliced(self, gaussians: Gaussians, points: Float[Tensor, "N 3"], time: float) -> Gaussians:
        ambient = self.coordinates(self.slicer(self._entry(points, time)))
        place = positional_encoding(points, self.frequencies)
        looks = self.looks(torch.cat((place, positional_encoding(ambient, 1)), dim=1))
        bands = gaussians.sh.shape[1]
        color = nn.functional.pad(looks[:, None, 1:], (0, 0, 0, bands - 1))
        return replace(
            gaussians,
            opacity_logits=gaussians.opacity_logits + looks[:, 0],
            sh=gaussians.sh + color,
        )

    def jacobians(self, points: Float[Tensor, "S 3"], time: float) -> Float[Tensor, "S 3 3"]:
        """Derivatives of `warp` by place, central differences.

        Exact ones in forward mode take several times as long on a CPU; these differ only where a
        ReLU has its kink within the step.
        """
        steps = DIFFERENCE * torch.eye(3, dtype=points.dtype, device=points.device)
        beside = torch.cat([points + step for step in (*steps, *-steps)])
        after, before = self.warp(beside, time).unflatten(0, (2, 3, -1))
        return ((after - before) / (2 * DIFFERENCE)).permute(1, 2, 0)

    def regularizers(self) -> dict[str, Tensor]:
        """ "elastic": how far the warp of the last training pass is from rigid: Geman-McClure of
        the logarithms of its stretches, at some of the Gaussians (Nerfies, eq. 6 and 7)."""
        if self._seen is None:
            return {}
        stretches = torch.linalg.svdvals(self.jacobians(*self._seen))
        squared = stretches.clamp_min(1e-6).log().square().sum(-1) / ELASTIC_SCALE**2
        return {"elastic": (2 * squared / (squared + 4)).mean()}


def glorot(net: nn.Module) -> None:
    """Every layer as flax starts it in Nerfies and HyperNeRF: `glorot_uniform`, no bias.

    PyTorch's own start shrinks what differs between places and times by sqrt(6) a layer: behind six
    of them all places and times look alike to the field.
    """
    for layer in net.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)


def near_zero(layer: nn.Linear, spread: float) -> None:
    """Weights uniform in [0, spread], as flax's `uniform(scale)`; no bias."""
    nn.init.uniform_(layer.weight, 0, spread)
    nn.init.zeros_(layer.bias)
