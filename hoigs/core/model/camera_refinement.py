"""Learnable corrections of the cameras that a clip brings, off unless `train.rates.camera` > 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.errors import SpecError
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.maths.splines import neighbours
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import CAMERAS_REFINED, Clip


class CameraRefinement(nn.Module):
    """A rigid motion in camera space for each frame: x_cam = Exp(delta) (R x + t); all start at 0.

    Turns are about the camera's own centre, so that they leave it in place. Frames that are not
    trained on follow their trained neighbours in time, linearly, so that a test frame's own image
    has no part in its camera. What moves all cameras and the scene together changes no image; only
    `penalty` holds it (so it is with BARF, Lin et al. 2021).

    Args:
        times: of the clip's frames. trained: positions of those that are trained on.
        extent: metres in one unit of `shifts`, so that one learning rate suits turns and shifts.

    Attributes:
        turns: radians [F, 3]. shifts: in extents [F, 3].
    """

    def __init__(self, times: Sequence[float], trained: Sequence[int], extent: float) -> None:
        super().__init__()
        self.turns = nn.Parameter(torch.zeros(len(times), 3))
        self.shifts = nn.Parameter(torch.zeros(len(times), 3))
        self.times, self.extent = list(times), extent
        self.trained = sorted(trained, key=lambda p: times[p])
        self._own = set(trained)

    @classmethod
    def of(cls, clip: Clip) -> CameraRefinement:
        return cls([m.time for m in clip.moments], clip.split["train"], clip.extent())

    def delta(self, position: int) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        """Turn, radians, and shift, metres, of the frame at a position of the clip."""
        if position in self._own:
            return self.turns[position], self.shifts[position] * self.extent
        low, high, r = neighbours(self.times[position], [self.times[p] for p in self.trained])
        a, b = self.trained[low], self.trained[high]
        turn = torch.lerp(self.turns[a], self.turns[b], r)
        return turn, torch.lerp(self.shifts[a], self.shifts[b], r) * self.extent

    def forward(self, camera: Camera, position: int) -> Camera:
        """The camera of the frame at `position`, moved; differentiable in the corrections."""
        return camera.moved(*self.delta(position))

    def penalty(self, position: int) -> Float[Tensor, ""]:
        """Squared turn, rad^2, and squared shift, extents^2, of one frame."""
        return self.turns[position].square().sum() + self.shifts[position].square().sum()

    @torch.no_grad()
    def refined(self, clip: Clip) -> Clip:
        """The clip with corrected cameras, named in its provenance; held-out cameras stay."""
        cameras = [self(camera, i) for i, camera in enumerate(clip.cameras)]
        provenance: dict[str, Any] = {**clip.provenance, CAMERAS_REFINED: True}
        return replace(clip, cameras=cameras, provenance=provenance)


def check_camera_gradients(rasterizer: Rasterizer) -> None:
    """Raises SpecError unless the rasterizer has gradients for cameras."""
    if not rasterizer.capabilities.camera_gradients:
        raise SpecError(
            f"train.rates.camera > 0 refines cameras, but {type(rasterizer).__name__} gives no "
            "camera gradients; use rasterizer:warp or rasterizer:torch, or set train.rates.camera=0"
        )
