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
from hoigs.plugins.deformation.deltas import (
    Space,
    Turning,
    apply_delta,
    clamped_time,
    with_residual,
)
from hoigs.plugins.deformation.encoding import SkipTrunk, encoded_width, positional_encoding
from hoigs.plugins.deformation.rigid_track import RigidTrack


class MlpConfig(ComponentConfig):
    """D3DGS's network; smaller sizes suit small entities (methods B.2).

    Attributes:
        width, depth: of the trunk. position_frequencies, time_frequencies: octaves of the
            positional encodings. track: deform about the object's rigid track, where it has one.
        space, turning: how scales and rotations are added, see `apply_delta`; D3DGS's are
            "activated" and "added".
        zero_heads: start at rest; D3DGS starts with torch's default weights.
        start: share of the run in which nothing moves (D3DGS: its first 3000 steps).
        time_noise: standard deviation, in frames, of the noise on the time of a training step at
            the start (D3DGS: 0.1 for real scenes); it falls linearly to 0 at `noise_until`.
        noise_until: share of the run after which there is no `time_noise`.
    """

    width: int = Field(256, ge=8)
    depth: int = Field(8, ge=2)
    position_frequencies: int = Field(10, ge=0)
    time_frequencies: int = Field(10, ge=0)
    track: bool = True
    space: Space = "raw"
    turning: Turning = "composed"
    zero_heads: bool = True
    start: float = Field(0.0, ge=0, lt=1)
    time_noise: float = Field(0.0, ge=0)
    noise_until: float = Field(0.5, gt=0, le=1)


class MlpDeformation(DeformationModel):
    """Offsets of centre, rotation and scale from [PE(x, y, z); PE(t)].

    The trunk has `depth` ReLU layers and takes its input again after the one with index depth / 2,
    as in D3DGS's code; the three heads are linear. Centres are detached at the network's input, as
    there. Times outside [0, 1] are held at the ends.

    Args:
        frames: of the clip, the unit of `time_noise`; needed when that is not 0.
        track: rest is then the canonical object, deformed before the rigid motion is applied.
        The others are MlpConfig's.
    """

    cut_gradients = frozenset({"means"})

    def __init__(
        self,
        width: int = 256,
        depth: int = 8,
        position_frequencies: int = 10,
        time_frequencies: int = 10,
        *,
        space: Space = "raw",
        turning: Turning = "composed",
        zero_heads: bool = True,
        start: float = 0.0,
        time_noise: float = 0.0,
        noise_until: float = 0.5,
        frames: int | None = None,
        track: ObjectTrack | None = None,
    ) -> None:
        super().__init__()
        if time_noise > 0 and frames is None:
            raise ValueError("time_noise is in frames: MlpDeformation needs `frames`")
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        entry = encoded_width(3, position_frequencies) + encoded_width(1, time_frequencies)
        # "after layer i" is before layer i + 1; a trunk too short for that takes it at its last
        self.trunk = SkipTrunk(entry, width, depth, min(depth // 2 + 1, depth - 1))
        self.heads = nn.Linear(width, 3 + 4 + 3)
        if zero_heads:
            nn.init.zeros_(self.heads.weight)
            nn.init.zeros_(self.heads.bias)
        self.space, self.turning, self.start = space, turning, start
        self.time_noise, self.noise_until = time_noise / (frames or 1), noise_until
        self.track = RigidTrack(track) if track is not None else None
        self.rest_space = "world" if track is None else "canonical"

    @classmethod
    def from_config(cls, config: MlpConfig, context: BuildContext) -> Self:
        settings = config.model_dump(exclude={"track"})
        if context.clip is not None:
            settings["frames"] = context.clip.num_frames
        return cls(**settings, track=context.object_track if config.track else None)

    def delta(self, means: Float[Tensor, "N 3"], time: float) -> GaussianDelta:
        """What the network adds at `time` to Gaussians centred at `means` (canonical, metres)."""
        clock = means.new_full((1, 1), clamped_time(time))
        code = positional_encoding(clock, self.time_frequencies).expand(len(means), -1)
        entry = torch.cat((positional_encoding(means, self.position_frequencies), code), dim=-1)
        means_delta, quats_delta, scales_delta = self.heads(self.trunk(entry)).split(
            (3, 4, 3), dim=-1
        )
        return GaussianDelta(means=means_delta, quats=quats_delta, log_scales=scales_delta)

    def noise_now(self) -> float:
        """Standard deviation of the noise on time at this point of the run, in clip lengths."""
        return self.time_noise * max(0.0, 1 - self.progress / self.noise_until)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = rest
        if self.progress >= self.start:
            time = moment.time
            if self.training and torch.is_grad_enabled() and self.noise_now() > 0:
                time += float(torch.randn(())) * self.noise_now()
            delta = self.delta(rest.means.detach(), time)
            moved = apply_delta(rest, delta, space=self.space, turning=self.turning)
        if self.track is not None:
            means, quats = self.track.place(moved.means, moved.quats, moment.time)
            moved = replace(moved, means=means, quats=quats)
        return with_residual(moved, residual)
