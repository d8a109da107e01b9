"""deformation:mlp: a coordinate network moves the Gaussians (Deformable-3DGS, Yang et al. 2024)."""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.clip import ObjectTrack
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import GaussianDelta, Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.plugins.deformation.rigid_track import RigidTrack


class MlpConfig(ComponentConfig):
    """D3DGS's network; smaller sizes suit small entities (methods B.2).

    Attributes:
        width, depth: of the trunk. position_frequencies, time_frequencies: octaves of the
            positional encodings. track: deform about the object's rigid track, where it has one.
    """

    width: int = Field(256, ge=8)
    depth: int = Field(8, ge=2)
    position_frequencies: int = Field(10, ge=0)
    time_frequencies: int = Field(10, ge=0)
    track: bool = True


def positional_encoding(
    x: Float[Tensor, "*batch D"], frequencies: int
) -> Float[Tensor, "*batch E"]:
    """[x, sin(2^0 x), cos(2^0 x), ..., cos(2^(L-1) x)], E = D (1 + 2 L) (D3DGS, time_utils)."""
    bands = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = (x[..., None, :] * bands[:, None]).flatten(-2)
    return torch.cat((x, angles.sin(), angles.cos()), dim=-1)


class MlpDeformation(DeformationModel):
    """Offsets of centre, rotation and scale from [PE(x, y, z); PE(t)].

    The trunk has `depth` ReLU layers and takes its input again after the middle one; the three
    heads are linear and start at zero, so that the entity starts at rest (or on its track).
    Centres are detached at the network's input, as in D3DGS. Deltas are added in raw space
    through `Gaussians.moved`. Times outside [0, 1] are held at the ends.

    Args:
        width, depth, position_frequencies, time_frequencies: as MlpConfig.
        track: rest is then the canonical object, deformed before the rigid motion is applied.
    """

    def __init__(
        self,
        width: int = 256,
        depth: int = 8,
        position_frequencies: int = 10,
        time_frequencies: int = 10,
        *,
        track: ObjectTrack | None = None,
    ) -> None:
        super().__init__()
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        entry = 3 * (1 + 2 * position_frequencies) + 1 + 2 * time_frequencies
        self.skip = depth // 2
        widths_in = [entry] + [width] * (depth - 1)
        widths_in[self.skip] += entry
        self.trunk = nn.ModuleList(nn.Linear(n, width) for n in widths_in)
        self.heads = nn.Linear(width, 3 + 4 + 3)
        nn.init.zeros_(self.heads.weight)
        nn.init.zeros_(self.heads.bias)
        self.track = RigidTrack(track) if track is not None else None
        self.rest_space = "world" if track is None else "canonical"

    @classmethod
    def from_config(cls, config: MlpConfig, context: BuildContext) -> Self:
        settings = config.model_dump(exclude={"track"})
        return cls(**settings, track=context.object_track if config.track else None)

    def delta(self, means: Float[Tensor, "N 3"], time: float) -> GaussianDelta:
        """What the network adds at `time` to Gaussians centred at `means` (canonical, metres)."""
        clock = means.new_full((1, 1), min(max(time, 0.0), 1.0))
        code = positional_encoding(clock, self.time_frequencies).expand(len(means), -1)
        entry = torch.cat((positional_encoding(means, self.position_frequencies), code), dim=-1)
        hidden = entry
        for i, layer in enumerate(self.trunk):
            if i == self.skip:
                hidden = torch.cat((entry, hidden), dim=-1)
            hidden = torch.relu(layer(hidden))
        means_delta, quats_delta, scales_delta = self.heads(hidden).split((3, 4, 3), dim=-1)
        return GaussianDelta(means=means_delta, quats=quats_delta, log_scales=scales_delta)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = rest.moved(self.delta(rest.means.detach(), moment.time))
        if self.track is not None:
            means, quats = self.track.place(moved.means, moved.quats, moment.time)
            moved = replace(moved, means=means, quats=quats)
        if residual is not None and residual.means is not None:
            moved = replace(moved, means=moved.means + residual.means)
        return moved
