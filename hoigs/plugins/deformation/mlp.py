"""deformation:mlp: a coordinate network moves the Gaussians (Deformable-3DGS, Yang et al. 2024,
arXiv:2309.13101).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.parameters import zeroed
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import GaussianDelta, Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.fields import (
    SkipTrunk,
    Space,
    Turning,
    apply_delta,
    clamped_time,
    clip_length,
    encoded_width,
    positional_encoding,
    with_residual,
)
from hoigs.plugins.deformation.rigid_track import RigidTrack


class MlpConfig(ComponentConfig):
    """D3DGS's network; smaller sizes are enough for small entities."""

    width: int = Field(default=256, ge=8)
    """Width of the trunk's layers."""
    depth: int = Field(default=8, ge=2)
    """Layers of the trunk."""
    position_frequencies: int = Field(default=10, ge=0)
    """Octaves of the positional encoding of the position."""
    time_frequencies: int = Field(default=10, ge=0)
    """Octaves of the positional encoding of time."""
    track: bool = True
    """Deform about the object's rigid track, where it has one."""
    space: Space = "raw"
    """How scales and rotations are added, see `apply_delta`; D3DGS's are "activated" and "added".
    """
    turning: Turning = "composed"
    """How scales and rotations are added, see `apply_delta`; D3DGS's are "activated" and "added".
    """
    zero_heads: bool = True
    """Start without motion; D3DGS starts with PyTorch's default weights."""
    start: float = Field(default=0.0, ge=0, lt=1)
    """Share of the run in which nothing moves (D3DGS: its first 3000 steps)."""
    time_noise: float = Field(default=0.0, ge=0)
    """Standard deviation, in frames, of the noise on the time of a training step at the start
    (D3DGS: 0.1 for real scenes); it falls linearly to 0 at `noise_until`."""
    noise_until: float = Field(default=0.5, gt=0, le=1)
    """Share of the run after which there is no `time_noise`."""


class MlpDeformation(DeformationModel):
    """Offsets of mean, rotation and scale from [PE(x, y, z); PE(t)].

    The trunk has `depth` ReLU layers and takes its input again after the one with index depth / 2,
    as in D3DGS's code; the three heads are linear. Means are detached at the network's input, as
    there. Times outside [0, 1] are those of the ends.

    Args:
        num_frames: frames in the clip, the unit of `time_noise`; needed unless that is 0.
        track: object track; Gaussians are then canonical, and deformed before the rigid motion.

    Raises:
        ValueError: `time_noise` without `num_frames`.
    """

    Config: ClassVar = MlpConfig
    cut_gradients = frozenset({"means"})

    def __init__(
        self,
        config: MlpConfig | None = None,
        *,
        num_frames: int | None = None,
        track: ObjectTrack | None = None,
    ) -> None:
        super().__init__()
        self.config = config = config or MlpConfig()
        if config.time_noise > 0 and num_frames is None:
            raise ValueError("time_noise is in frames: MlpDeformation needs num_frames")
        entry = encoded_width(3, config.position_frequencies)
        entry += encoded_width(1, config.time_frequencies)
        # "after layer i" is before layer i + 1, or before the last layer of a short trunk
        skip = min(config.depth // 2 + 1, config.depth - 1)
        self.trunk = SkipTrunk(entry, config.width, config.depth, skip)
        self.heads = nn.Linear(config.width, 3 + 4 + 3)
        if config.zero_heads:
            zeroed(self.heads)
        self.time_noise = config.time_noise / (num_frames or 1)
        self.track = RigidTrack(track) if track is not None else None
        self.input_space = "world" if track is None else "canonical"

    @classmethod
    def from_config(cls, config: MlpConfig, context: BuildContext) -> Self:
        track = context.object_track if config.track else None
        return cls(config, num_frames=clip_length(context), track=track)

    def delta(self, means: Float[Tensor, "N 3"], time: float) -> GaussianDelta:
        """What is added at `time` to Gaussians whose canonical means are `means`, metres."""
        instant = means.new_full((1, 1), clamped_time(time))
        code = positional_encoding(instant, self.config.time_frequencies).expand(len(means), -1)
        place = positional_encoding(means, self.config.position_frequencies)
        outputs = self.heads(self.trunk(torch.cat((place, code), dim=-1)))
        moved, turned, scaled = outputs.split((3, 4, 3), dim=-1)
        return GaussianDelta(means=moved, quats=turned, log_scales=scaled)

    def noise_now(self) -> float:
        """Standard deviation of the noise on time at this point of the run, in clip lengths."""
        return self.time_noise * max(0.0, 1 - self.progress / self.config.noise_until)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = canonical
        if self.progress >= self.config.start:
            time = moment.time
            if self.training and torch.is_grad_enabled() and self.noise_now() > 0:
                time += float(torch.randn(())) * self.noise_now()
            delta = self.delta(canonical.means.detach(), time)
            moved = apply_delta(
                canonical, delta, space=self.config.space, turning=self.config.turning
            )
        if self.track is not None:
            means, quats = self.track.place(moved.means, moved.quats, moment.time)
            moved = replace(moved, means=means, quats=quats)
        return with_residual(moved, residual)
