"""Pictures of films: size, background, dithering, and the video beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.viewing.viewer.pictures.fitting import placed

LARGEST = 8192  # pixels of a side


def dithered(color: Float[Tensor, "H W C"], index: int = 0) -> UInt8[np.ndarray, "H W C"]:
    """Colours in [0, 1] at 8 bits, with noise in place of steps, so that gradients show no bands.

    The noise is interleaved gradient noise (Jimenez 2014), another for each picture `index`; the
    mean over a few pixels or pictures is the colour, and none is more than one step away.
    """
    height, width = color.shape[:2]
    y, x = np.mgrid[:height, :width] + 5.588238 * (index % 64)
    noise = np.modf(52.9829189 * np.modf(0.06711056 * x + 0.00583715 * y)[0])[0]
    value = color.detach().clamp(0, 1).cpu().numpy().astype(np.float64) * 255
    steps: np.ndarray = np.floor(value + noise[..., None]).clip(0, 255).astype(np.uint8)
    return steps


def fitted(camera: Camera, width: int | None, height: int | None) -> Camera:
    """The same view at a size: one side alone keeps the aspect, both cut what does not fit.

    Raises:
        HoigsError: a side that is odd, which videos do not take, or out of bounds.
    """
    if width is None and height is None:
        return camera
    for name, side in (("width", width), ("height", height)):
        if side is not None and (side % 2 or not 16 <= side <= LARGEST):
            raise HoigsError(f"{name} {side}: expected an even number from 16 to {LARGEST}")
    aspect = camera.width / camera.height
    wide = width if width is not None else max(16, 2 * round((height or 0) * aspect / 2))
    high = height if height is not None else max(16, 2 * round(wide / aspect / 2))
    scale = max(wide / camera.width, high / camera.height)
    full = round(camera.width * scale), round(camera.height * scale)
    left, top = (max(0, full[0] - wide) // 2, max(0, full[1] - high) // 2)
    return camera.resized(*full).cropped(left, top, wide, high)


def read_background(text: str, camera: Camera) -> Tensor:
    """A colour [3], or an image [H, W, 3] that fills the view, RGB in [0, 1].

    Raises:
        HoigsError: neither a colour nor an image file.
    """
    from PIL import Image, ImageColor, UnidentifiedImageError

    try:
        return torch.tensor(ImageColor.getrgb(text)[:3]) / 255.0
    except ValueError:
        pass
    path = Path(text)
    if not path.is_file():
        raise HoigsError(
            f'background "{text}": expected a colour ("white", "#20242a"), an image file, or '
            '"transparent"'
        )
    try:
        with Image.open(path) as opened:
            return _filling(np.asarray(opened.convert("RGB")), camera.width, camera.height)
    except (UnidentifiedImageError, OSError) as error:
        raise HoigsError(f"background {path}: not an image: {error}") from error


def source_frame(
    clip: Clip,
    frame: float,
    camera: Camera,
    channels: int,
    shape: tuple[int, int] | None = None,
) -> UInt8[np.ndarray, "H W C"]:
    """The nearest frame of the video, as large as the picture beside it.

    Args:
        shape: width and height into which frames of another size are fitted whole first, as the
            film's cameras were.
    """
    nearest = min(range(len(clip)), key=lambda i: abs(clip.moments[i].index - frame))
    own = clip.store.image(nearest).numpy()
    if shape is not None and shape != (own.shape[1], own.shape[0]):
        own = placed(own, shape)
    image = _filling(own, camera.width, camera.height)
    array: np.ndarray = (image * 255).round().to(torch.uint8).numpy()
    if channels == 4:
        array = np.concatenate((array, np.full_like(array[..., :1], 255)), -1)
    return array


def _filling(image: UInt8[np.ndarray, "h w 3"], width: int, height: int) -> Float[Tensor, "H W 3"]:
    """An image at a size, in [0, 1]; what does not fit is cut at both ends."""
    from PIL import Image, ImageOps

    fit = ImageOps.fit(Image.fromarray(image), (width, height), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(fit)).float() / 255.0
