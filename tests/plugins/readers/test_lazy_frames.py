"""LazyFrames: nothing early, one size, alpha over a colour, masks and depth as bent as images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hoigs.core.errors import ClipError
from hoigs.core.values.camera import Camera
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.lazy_frames import DepthFiles, LazyFrames, MaskFiles, PixelFiles, dark

W, H = 24, 16
CAMERA = Camera(torch.tensor([[20.0, 0, 13], [0, 20.0, 7], [0, 0, 1]]), torch.eye(4), W, H)


def picture(folder: Path, name: str, pixels: np.ndarray) -> Path:
    path = folder / name
    Image.fromarray(pixels).save(path)
    return path


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return picture(tmp_path, "0.png", np.full((H, W, 3), 90, np.uint8))


def test_decodes_when_asked_and_keeps_what_fits(tmp_path: Path, image: Path) -> None:
    store = LazyFrames(tmp_path, PixelFiles([image, tmp_path / "absent.png"]), [CAMERA] * 2)
    assert store.cache.cached_bytes == 0
    assert store.image(0) is store.image(0) and store.image(0).dtype == torch.uint8
    assert store.cache.cached_bytes == W * H * 3
    with pytest.raises(ClipError, match=r"absent\.png cannot be decoded"):
        store.image(1)
    assert store.depth(0) is None and store.ignored(0) is None


def test_alpha_is_laid_over_the_background(tmp_path: Path) -> None:
    rgba = np.zeros((H, W, 4), np.uint8)
    rgba[..., 0], rgba[..., 3] = 200, 102
    path = picture(tmp_path, "a.png", rgba)
    white = LazyFrames(tmp_path, PixelFiles([path], background=(255, 255, 255)), [CAMERA])
    assert white.image(0)[0, 0].tolist() == [233, 153, 153]
    assert LazyFrames(tmp_path, PixelFiles([path]), [CAMERA]).image(0)[0, 0].tolist() == [80, 0, 0]


def test_greys_of_16_bits(tmp_path: Path) -> None:
    path = picture(tmp_path, "deep.png", np.full((H, W), 100 * 257, np.uint16))
    assert LazyFrames(tmp_path, PixelFiles([path]), [CAMERA]).image(0)[0, 0].tolist() == [100] * 3
    odd = tmp_path / "light.tif"
    Image.fromarray(np.full((H, W), 0.5, np.float32)).save(odd)
    with pytest.raises(ClipError, match=r"light\.tif.*0\.5"):
        LazyFrames(tmp_path, PixelFiles([odd]), [CAMERA]).image(0)


def test_masks_of_any_polarity_and_size(tmp_path: Path, image: Path) -> None:
    half = np.zeros((H // 2, W // 2), np.uint8)
    half[2, 3] = 255
    path = picture(tmp_path, "m.png", half)
    masks = {"a": MaskFiles([path, None]), "b": MaskFiles([path, path], dark)}
    store = LazyFrames(tmp_path, PixelFiles([image] * 2, masks=masks), [CAMERA] * 2)
    want = torch.zeros(H, W, dtype=torch.bool)
    want[4:6, 6:8] = True
    assert store.mask("a", 0).equal(want) and store.mask("b", 0).equal(~want)
    assert not store.mask("a", 1).any()


def test_a_mask_of_another_shape_is_refused(tmp_path: Path, image: Path) -> None:
    path = picture(tmp_path, "m.png", np.zeros((H, H), np.uint8))
    store = LazyFrames(tmp_path, PixelFiles([image], masks={"a": MaskFiles([path])}), [CAMERA])
    with pytest.raises(ClipError, match=r"m\.png is 16x16, the frame 24x16"):
        store.mask("a", 0)


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    path = picture(tmp_path, "s.png", np.zeros((H // 2, W // 2, 3), np.uint8))
    with pytest.raises(ClipError, match=r"s\.png is 12x8, its camera 24x16"):
        LazyFrames(tmp_path, PixelFiles([path]), [CAMERA]).image(0)


def test_depth_is_scaled_and_cleaned(tmp_path: Path, image: Path) -> None:
    millimetres = np.full((H, W), 1500, np.uint16)
    millimetres[0, 0] = 0
    values = np.full((H, W), 2.0, np.float32)
    values[0, :3] = np.nan, np.inf, -1
    np.save(tmp_path / "d.npy", values)
    paths = [picture(tmp_path, "d.png", millimetres), None]
    store = LazyFrames(
        tmp_path, PixelFiles([image] * 2, depth=DepthFiles(paths, 0.001)), [CAMERA] * 2
    )
    depth = store.depth(0)
    assert depth is not None and depth[0, 0] == 0 and depth[1, 1] == pytest.approx(1.5)
    assert store.depth(1) is None
    store = LazyFrames(
        tmp_path, PixelFiles([image], depth=DepthFiles([tmp_path / "d.npy"])), [CAMERA]
    )
    depth = store.depth(0)
    assert depth is not None and depth[0, :4].tolist() == [0, 0, 0, 2]


def test_a_depth_map_without_pixels_is_refused(tmp_path: Path, image: Path) -> None:
    np.save(tmp_path / "d.npy", np.zeros((0, W), np.float32))
    store = LazyFrames(
        tmp_path, PixelFiles([image], depth=DepthFiles([tmp_path / "d.npy"])), [CAMERA]
    )
    with pytest.raises(ClipError, match=r"d\.npy is 24x0, the frame 24x16"):
        store.depth(0)


def test_one_map_bends_images_masks_and_depth(tmp_path: Path) -> None:
    """A blob lands in the same pixels in all three, and elsewhere than in the file."""
    blob = np.zeros((H, W), np.uint8)
    blob[2:5, 2:5] = 255
    lens = Lens("OPENCV", (20.0, 20, 13, 7, 0.4, 0, 0, 0), W, H)
    image = picture(tmp_path, "i.png", np.repeat(blob[..., None], 3, -1))
    mask, depth = picture(tmp_path, "m.png", blob), tmp_path / "d.npy"
    np.save(depth, blob / 100)
    files = PixelFiles([image], masks={"a": MaskFiles([mask])}, depth=DepthFiles([depth]))
    store = LazyFrames(tmp_path, files, [CAMERA], lenses=[lens])
    seen = store.mask("a", 0)
    assert not seen.equal(torch.from_numpy(blob > 0)) and seen.any()
    depths = store.depth(0)
    assert depths is not None and (depths > 0).equal(seen)
    gray = store.image(0)[..., 0]
    assert gray[seen].float().mean() > 6 * gray[~seen].float().mean()
    ignored = store.ignored(0)
    assert ignored is not None and ignored[0, 0] and not ignored[7, 13]


def test_lists_of_unlike_length_are_refused(tmp_path: Path, image: Path) -> None:
    with pytest.raises(ValueError, match="different lengths"):
        LazyFrames(tmp_path, PixelFiles([image] * 2), [CAMERA])
