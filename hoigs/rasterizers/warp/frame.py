"""Frame: one render's settings and tensors, as the two device paths share them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hoigs.core.errors import RenderError

INT32 = 2**31 - 1


@dataclass(frozen=True)
class Settings:
    """What is no tensor in one render; see `RenderRequest` for most of it."""

    width: int
    height: int
    bands: int
    near: float
    low_pass: float
    max_alpha: float
    min_alpha: float
    min_transmittance: float


@dataclass(frozen=True)
class Inputs:
    """Contiguous float32 tensors of one render on one device; absent ones are empty.

    Attributes:
        means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh [N, K, 3]: raw space.
        features [N, F]; offsets [N, 2] pixels; subset [N] uint8.
        background: [3] or [H, W, 3].
        K [3, 3], view [4, 4]: of the camera.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    features: Tensor
    offsets: Tensor
    background: Tensor
    view: Tensor
    K: Tensor
    subset: Tensor

    @property
    def count(self) -> int:
        return self.means.shape[0]

    @property
    def channels(self) -> int:
        return self.features.shape[1]


@dataclass(frozen=True)
class Lists:
    """The Gaussians of each tile, nearest first. See `records` for pair and slot."""

    tile_rows: int
    across: int
    down: int
    pairs: Tensor  # [M, 2] int32
    offsets: Tensor  # [tiles + 1] int32
    first: Tensor  # [N] int32
    slots: Tensor  # [N] int32

    @property
    def tiles(self) -> int:
        return self.across * self.down


@dataclass(frozen=True)
class Images:
    """color [H, W, 3] over the background, alpha [H, W], depth [H, W], extra [H, W, F]."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    extra: Tensor

    @staticmethod
    def empty(inputs: Inputs, settings: Settings) -> Images:
        size, new = (settings.height, settings.width), inputs.means.new_empty
        return Images(new(*size, 3), new(size), new(size), new(*size, inputs.channels))


def check_addressable(numbers: int, what: str) -> None:
    """Raise when kernels could not address so many numbers with their 32-bit indices.

    Raises:
        RenderError: too many.
    """
    if numbers > INT32:
        raise RenderError(
            f"WarpRasterizer: {what} make {numbers} numbers, more than {INT32}, the most in one "
            "render; render parts of the image (Camera.cropped), or fewer channels at a time"
        )
