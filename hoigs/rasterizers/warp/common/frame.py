"""The settings and tensors of one render, as all devices share them."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hoigs.core.errors import RenderError

INT32 = 2**31 - 1


@dataclass(frozen=True)
class Settings:
    """What is no tensor in one render; see `RenderRequest` for most of it.

    Attributes:
        active_bases: how many SH basis functions are used: 1, 4, 9 or 16.
    """

    width: int
    height: int
    active_bases: int
    near: float
    low_pass: float
    antialiased: bool
    max_alpha: float
    min_alpha: float
    min_transmittance: float


@dataclass(frozen=True)
class Inputs:
    """Contiguous float32 tensors of one render on one device; absent ones are empty.

    Attributes:
        means [N, 3], quats [N, 4], log_scales [N, 3], opacity_logits [N], sh [N, K, 3]: raw space.
        features [N, F]; screen_offsets [N, 2] pixels; subset [N] uint8.
        absolute_gradients [N, 2]: receives them; its values are not read.
        background: [3] or [H, W, 3].
        world_to_camera [4, 4], K [3, 3]: of the camera.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    features: Tensor
    screen_offsets: Tensor
    background: Tensor
    world_to_camera: Tensor
    K: Tensor
    subset: Tensor
    absolute_gradients: Tensor

    @property
    def count(self) -> int:
        return self.means.shape[0]

    @property
    def channels(self) -> int:
        return self.features.shape[1]


@dataclass(frozen=True)
class TileIntersections:
    """The Gaussians of each tile, nearest first.

    Attributes:
        tile_height: pixels; tiles_x, tiles_y: number of tiles.
        offsets: [tiles + 1] int32, the first intersection of each tile. On CUDA more follows, see
            `intersect.cuda_kernels`.
        indices: [M, 2] int32, of each intersection the Gaussian and the partial (`common.records`).
        first_partial: [N] int32, the first partial of each Gaussian.
        tiles_per_gaussian: [N] int32, how many tiles, and so partials, each Gaussian has.
    """

    tile_height: int
    tiles_x: int
    tiles_y: int
    offsets: Tensor
    indices: Tensor
    first_partial: Tensor
    tiles_per_gaussian: Tensor

    @property
    def tiles(self) -> int:
        return self.tiles_x * self.tiles_y

    @property
    def count(self) -> int:
        """Intersections for which there is memory; on a CPU, how many there are."""
        return self.indices.shape[0]


@dataclass(frozen=True)
class Images:
    """color [H, W, 3] over the background, alpha [H, W], depth [H, W], features [H, W, F]."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    features: Tensor

    @staticmethod
    def empty(inputs: Inputs, settings: Settings) -> Images:
        size, new = (settings.height, settings.width), inputs.means.new_empty
        return Images(new(*size, 3), new(size), new(size), new(*size, inputs.channels))


def check_addressable(numbers: int, what: str) -> None:
    """Raise where kernels cannot address so many numbers with their 32-bit indices.

    Raises:
        RenderError: too many.
    """
    if numbers > INT32:
        raise RenderError(
            f"WarpRasterizer: {what} make {numbers} numbers, more than {INT32}, the most in one "
            "render; render parts of the image (Camera.cropped), or fewer channels at a time"
        )
