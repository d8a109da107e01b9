"""reader:clip decodes lazily, keeps a bounded cache, and refuses what the checker refuses."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from hoigs.core.clip_folder.write import ClipWriter
from hoigs.core.errors import ClipError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.plugins.readers.clip import ClipFolderReader, FolderStore

FRAMES, SIZE = 5, 16


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    K = torch.tensor([[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]])
    with ClipWriter(tmp_path / "clip", fps=10, entities={"box": "object"}) as writer:
        for i in range(FRAMES):
            image = np.full((SIZE, SIZE, 3), i * 10, np.uint8)
            writer.add_frame(
                image, Camera(K, torch.eye(4), SIZE, SIZE), {"box": image[..., 0] < 25}
            )
        points, eyes = torch.rand(4, 3), torch.eye(3).expand(FRAMES, 3, 3)
        seen = torch.ones(FRAMES, dtype=torch.bool)
        writer.set_object("box", ObjectTrack(points, points, eyes, torch.zeros(FRAMES, 3), seen))
        writer.set_points(points, points)
    return tmp_path / "clip"


def test_config_and_matches(folder: Path) -> None:
    reader = ClipFolderReader.from_config(ClipFolderReader.Config(cache_mb=3), BuildContext())
    assert reader.config.cache_mb == 3
    assert reader.matches(folder) and not reader.matches(folder.parent)
    with pytest.raises(ValidationError):
        ClipFolderReader.Config(cache_gb=1)  # type: ignore[call-arg]


def test_nothing_is_decoded_before_it_is_asked_for(folder: Path) -> None:
    clip = ClipFolderReader().read(folder)
    assert isinstance(clip.store, FolderStore) and clip.store.cache.cached_bytes == 0
    frame = clip[3]
    assert frame.image.dtype == torch.uint8 and int(frame.image.max()) == 30
    assert frame.depth is None and not frame.masks["box"].any()
    assert clip.store.cache.cached_bytes == SIZE * SIZE * (3 + 1)


def test_cache_is_bounded_and_least_recently_used(folder: Path) -> None:
    store = FolderStore(folder, has_depth=False, cache_mb=0)
    assert store.image(0) is not store.image(0)
    store.cache.budget = 2 * SIZE * SIZE * 3
    first = store.image(0)
    store.image(1)
    assert store.image(0) is first
    store.image(2)
    assert store.cache.cached_bytes == store.cache.budget
    assert store.image(0) is first, "it was used last"
    assert store.image(1) is not None and store.cache.cached_bytes == store.cache.budget


def test_threads_may_read_together(folder: Path) -> None:
    store = FolderStore(folder, has_depth=False)
    store.cache.budget = 3 * SIZE * SIZE * 3
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda i: store.image(i % FRAMES), range(100)))
    assert all(int(image.max()) == 10 * (i % FRAMES) for i, image in enumerate(images))
    assert store.cache.cached_bytes == 3 * SIZE * SIZE * 3


def test_a_damaged_image_is_named(folder: Path) -> None:
    """Damage within is found when the frame is decoded, a cut-off file when the clip is checked."""
    path = folder / "images/00002.png"
    whole = path.read_bytes()
    path.write_bytes(whole[:50] + bytes(len(whole) - 62) + whole[-12:])
    clip = ClipFolderReader().read(folder)
    with pytest.raises(ClipError, match=r"00002\.png cannot be decoded"):
        clip.frame(2)


def test_an_inconsistent_folder_is_refused(folder: Path) -> None:
    (folder / "masks/box/00001.png").unlink()
    with pytest.raises(ClipError, match=r"masks/box/00001\.png is absent: masks come from"):
        ClipFolderReader().read(folder)
