"""PlateView: the one picture that all frames of a camera in one place are carried into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.preparation.scene.background_points import MASK_MARGIN, REFERENCE_WIDTH
from hoigs.preparation.video.resizing import shrink, shrink_mask
from hoigs.preparation.video.source import SourceError

WIDEST = 70  # degrees off the middle that one plane can show
LARGEST = 2000  # pixels of the plate's longer side

Shown = tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]


@dataclass(frozen=True)
class PlateView:
    """A camera without a turn that sees what all frames see.

    Attributes:
        camera: at most `REFERENCE_WIDTH` wide if all frames look the same way, else as fine and as
            wide as it takes.
        still: all frames look the same way.
        margin: pixels that masks are grown by.
    """

    camera: Camera
    still: bool
    margin: int

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> PlateView:
        """
        Raises:
            SourceError: the frames look into directions too far apart for one picture.
        """
        first = cameras[0]
        width = min(first.width, REFERENCE_WIDTH)
        small = first.resized(width, max(1, round(first.height * width / first.width)))
        margin = max(1, round(MASK_MARGIN * width / REFERENCE_WIDTH))
        poses = torch.stack([c.world_to_camera for c in cameras])
        if bool((poses == poses[0]).all()):
            return cls(small, True, margin)
        corners = torch.stack([_corners(c) for c in cameras]).reshape(-1, 3)
        off = float(torch.rad2deg(torch.acos(corners[:, 2].min())))
        if off > WIDEST:
            raise SourceError(
                f"the camera turns until it looks {off:.0f} degrees off the middle of its way, "
                f"and its background is made for {WIDEST} at most: choose a part (--start, --end)"
            )
        xy = corners[:, :2] / corners[:, 2:] * small.focal + small.K[:2, 2]
        low, high = xy.min(0).values.floor(), xy.max(0).values.ceil()
        wide = small.cropped(int(low[0]), int(low[1]), *(int(v) for v in high - low))
        wide = replace(wide, world_to_camera=torch.eye(4))
        shrunk = min(1.0, LARGEST / max(wide.width, wide.height))
        return cls(
            wide.resized(*(round(v * shrunk) for v in (wide.width, wide.height))), False, margin
        )

    def carried(
        self, image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"], camera: Camera
    ) -> Shown:
        """A frame and its mask as the plate's camera sees them; what it does not show is masked."""
        size = (self.camera.width, self.camera.height)
        if self.still:
            return shrink(image, *size), shrink_mask(moving, *size)
        width = round(camera.width * min(1.0, float(self.camera.K[0, 0] / camera.K[0, 0])))
        height = max(1, round(camera.height * width / camera.width))
        pixels, _ = self._pixels(camera.resized(width, height))
        tensor = torch.from_numpy(shrink(image, width, height)).permute(2, 0, 1)[None].float()
        moved = _sampled(tensor, pixels, "bilinear")[0].permute(1, 2, 0).round().byte().numpy()
        hidden = torch.from_numpy(shrink_mask(moving, width, height))[None, None].float()
        return moved, _sampled(1 - hidden, pixels, "nearest")[0, 0].numpy() < 0.5

    def carried_depth(
        self, metres: Float[np.ndarray, "H W"], moving: Bool[np.ndarray, "H W"], camera: Camera
    ) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Depth along z, 0 unknown, likewise."""
        if self.still:
            return metres, moving
        pixels, depth = self._pixels(camera)
        values = torch.from_numpy(np.where(moving, 0, metres).astype(np.float32))[None, None]
        found = _sampled(values, pixels, "nearest")[0, 0] / depth.clamp_min(1e-3)
        return found.numpy(), (found <= 0).numpy()

    def within(self, cameras: Sequence[Camera]) -> Bool[np.ndarray, "h w"]:
        """Pixels of the plate that some frame's picture shows."""
        if self.still:
            return np.ones((self.camera.height, self.camera.width), bool)
        shown = torch.zeros(self.camera.height, self.camera.width, dtype=torch.bool)
        for camera in cameras:
            pixels, depth = self._pixels(camera)
            shown |= camera.shows(pixels, depth)
        return shown.numpy()

    def _pixels(self, camera: Camera) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w"]]:
        """Where a camera sees what the plate's pixels show, and its depth if that is 1 in the
        plate."""
        grid = self.camera.pixel_grid()
        return camera.project(self.camera.unproject(grid, torch.ones(grid.shape[:2])))


def _corners(camera: Camera) -> Float[Tensor, "4 3"]:
    """Directions of a frame's corners in the world."""
    w, h = float(camera.width), float(camera.height)
    corners = camera.unproject(torch.tensor([[0, 0], [w, 0], [0, h], [w, h]]), torch.ones(4))
    return torch.nn.functional.normalize(corners, dim=-1)


def _sampled(
    values: Float[Tensor, "1 C H W"], pixels: Float[Tensor, "h w 2"], mode: str
) -> Float[Tensor, "1 C h w"]:
    """Images repeat their rim outside; nearest values are 0 there."""
    size = pixels.new_tensor((values.shape[3], values.shape[2]))
    at = (2 * pixels / size - 1).clamp(-9, 9)
    return torch.nn.functional.grid_sample(
        values, at[None], mode=mode, align_corners=False,
        padding_mode="border" if mode == "bilinear" else "zeros",
    )  # fmt: skip
