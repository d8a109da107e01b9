"""deformation:se3-field: a field of rigid motions from a code of time (Nerfies, Park et al. 2021,
arXiv:2011.12948; HyperNeRF, Park et al. 2021, arXiv:2106.13228), from canonical to world, where
NeRFs warp from world to canonical.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.rotations import exp_se3, multiply_quats, normalize_quats, quats_to_matrices
from hoigs.core.parameters import zeroed
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.fields import (
    SkipTrunk,
    TimeTable,
    UnitBox,
    clamped_time,
    encoded_width,
    positional_encoding,
    with_residual,
)

ELASTIC_SCALE = 0.03  # of the robust loss, in logarithms of stretch (Nerfies)
DIFFERENCE = 2e-4  # box units, for derivatives: far below the period of the highest octave


class Se3FieldConfig(ComponentConfig):
    """Nerfies' field (google/hypernerf: SE3Field), and HyperNeRF's slices."""

    code: int = Field(default=8, ge=1)
    """Width of the learned code of each trained frame; between frames it is interpolated."""
    width: int = Field(default=128, ge=8)
    """Width of the network's layers."""
    depth: int = Field(default=6, ge=1)
    """Layers of the network."""
    skip: int = Field(default=4, ge=1)
    """Index of the layer that takes the input again."""
    frequencies: int = Field(default=8, ge=0)
    """Octaves of the positional encoding of the position."""
    window_until: float = Field(default=0.32, ge=0, le=1)
    """Share of the run over which the octaves are added one after the other; 0 uses all at once."""
    ambient: int = Field(default=0, ge=0, le=8)
    """Number of HyperNeRF's extra coordinates, a function of place and time that colour and opacity
    depend on; 0 is Nerfies."""
    ambient_width: int = Field(default=64, ge=8)
    """Width of the layers of the network that gives the extra coordinates."""
    ambient_depth: int = Field(default=6, ge=1)
    """Layers of that network."""
    elastic_points: int = Field(default=128, ge=1)
    """Number of Gaussians, drawn anew at each step, at which the elastic loss is taken."""


class Se3Field(DeformationModel):
    """x -> R(x, t) x + T(x, t), and each Gaussian rotated by R; (R, T) = exp(MLP(PE(x), code(t))).

    Positions are read and moved in the bounding box of the Gaussians at the start, scaled to
    [-1, 1] by its largest half-side. Means are not detached. Times outside the trained frames are
    those of the first or last.

    With `ambient`, a second network gives w(x, t), and a third one, which starts at zero, adds to
    colour and opacity from (x, w): what appears and vanishes need not be moved out of sight.

    Args:
        times: times of the training frames, in [0, 1], ascending.
    """

    Config: ClassVar = Se3FieldConfig
    input_space: Literal["canonical", "world"] = "world"
    regularizer_weights: ClassVar[Mapping[str, float]] = {"elastic": 1e-3}

    config: Any  # of the subclass's Config

    def __init__(self, config: Se3FieldConfig | None = None, *, times: Sequence[float]) -> None:
        super().__init__()
        self.config = config = config or self.Config()
        self.codes = TimeTable(config.code, times)
        self.box = UnitBox()
        place = encoded_width(3, config.frequencies)
        entry = place + config.code
        self.trunk = SkipTrunk(entry, config.width, config.depth, config.skip)
        self.screw = nn.Linear(config.width, 6)
        glorot(self.trunk)
        near_zero(self.screw, 1e-4)
        if config.ambient:
            sizes = (config.ambient_width, config.ambient_depth, config.skip)
            self.slicer = SkipTrunk(entry, *sizes)
            self.coordinates = nn.Linear(config.ambient_width, config.ambient)
            glorot(self.slicer)
            near_zero(self.coordinates, 1e-2)
            first = nn.Linear(place + encoded_width(config.ambient, 1), config.width)
            last = nn.Linear(config.width, 1 + 3)
            self.looks = nn.Sequential(first, nn.ReLU(), last)
            glorot(self.looks)
            zeroed(last)
        self._sampled: tuple[Float[Tensor, "S 3"], float] | None = None

    @classmethod
    def from_config(cls, config: Se3FieldConfig, context: BuildContext) -> Self:
        clip = context.clip
        if clip is None:
            raise ValueError(
                f"{cls.__name__} needs a clip: it has a code for each trained frame, and the "
                "context has no clip"
            )
        train = clip.split.get("train", range(len(clip)))
        return cls(config, times=sorted({clip.moments[i].time for i in train}))

    def bind(self, canonical: Gaussians) -> None:
        self.box.bind(canonical)
        middle = (self.box.low + self.box.high) / 2
        half = (self.box.high - self.box.low).amax() / 2  # one scale, or R would shear
        self.box.low, self.box.high = middle - half, middle + half

    @property
    def window(self) -> float | None:
        """Number of octaves in use at this point of the run; None is all."""
        until = self.config.window_until
        if until == 0 or self.progress >= until:
            return None
        return self.config.frequencies * self.progress / until

    def motion(
        self, points: Float[Tensor, "N 3"], time: float
    ) -> tuple[Float[Tensor, "N 4"], Float[Tensor, "N 3"]]:
        """Quaternions and translations, in box units, at points of the box."""
        screw = self.screw(self.trunk(self._entry(points, time)))
        return exp_se3(screw[:, :3], screw[:, 3:])

    def warp(self, points: Float[Tensor, "N 3"], time: float) -> Float[Tensor, "N 3"]:
        """Where the field moves points of the box at `time`, box units."""
        return _moved(points, *self.motion(points, time))

    def _entry(self, points: Float[Tensor, "N 3"], time: float) -> Float[Tensor, "N E"]:
        place = positional_encoding(points, self.config.frequencies, self.window)
        return torch.cat((place, self.codes(clamped_time(time)).expand(len(points), -1)), dim=1)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        points = self.box(canonical.means)
        quats, shifts = self.motion(points, moment.time)
        moved = _moved(points, quats, shifts)
        half = (self.box.high - self.box.low) / 2
        out = replace(
            canonical,
            means=canonical.means + (moved - points) * half,
            quats=multiply_quats(quats, normalize_quats(canonical.quats)),
        )
        if self.config.ambient:
            out = self._sliced(out, points, moment.time)
        if self.training and torch.is_grad_enabled() and len(canonical):
            rows = torch.randint(len(canonical), (self.config.elastic_points,)).to(points.device)
            self._sampled = (points.detach()[rows], moment.time)
        return with_residual(out, residual)

    def _sliced(self, gaussians: Gaussians, points: Float[Tensor, "N 3"], time: float) -> Gaussians:
        ambient = self.coordinates(self.slicer(self._entry(points, time)))
        place = positional_encoding(points, self.config.frequencies)
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

        Exact derivatives in forward mode take several times as long on a CPU; these differ only
        where a ReLU has its kink within the step.
        """
        steps = DIFFERENCE * torch.eye(3, dtype=points.dtype, device=points.device)
        beside = torch.cat([points + step for step in (*steps, *-steps)])
        after, before = self.warp(beside, time).unflatten(0, (2, 3, -1))
        return ((after - before) / (2 * DIFFERENCE)).permute(1, 2, 0)

    def regularizers(self) -> dict[str, Tensor]:
        """ "elastic": how far the warp of the last training pass is from rigid (Nerfies).

        The Geman-McClure loss of the logarithms of the singular values of its Jacobians, at some of
        the Gaussians.
        """
        if self._sampled is None:
            return {}
        stretches = torch.linalg.svdvals(self.jacobians(*self._sampled))
        squared = stretches.clamp_min(1e-6).log().square().sum(-1) / ELASTIC_SCALE**2
        return {"elastic": (2 * squared / (squared + 4)).mean()}


def _moved(
    points: Float[Tensor, "N 3"], quats: Float[Tensor, "N 4"], shifts: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    return (quats_to_matrices(quats) @ points[..., None]).squeeze(-1) + shifts


def glorot(net: nn.Module) -> None:
    """Start every layer as Nerfies and HyperNeRF do: flax's `glorot_uniform`, bias zero.

    PyTorch's default shrinks the differences between places and times by sqrt(6) per layer: after
    six layers the features of all places and times are nearly equal.
    """
    for layer in net.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)


def near_zero(layer: nn.Linear, spread: float) -> None:
    """Start with weights uniform in [0, spread], as flax's `uniform(scale)`, and bias zero."""
    nn.init.uniform_(layer.weight, 0, spread)
    nn.init.zeros_(layer.bias)
