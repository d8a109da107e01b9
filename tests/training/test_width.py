"""train.width shrinks frames and never enlarges them."""

from __future__ import annotations

import pytest
import torch
from small_clip import small_clip

from hoigs.core.values import clip as clip_values
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.runs.clip_source import read_clip
from hoigs.synthesis import SceneConfig, builtin_clip
from hoigs.training.views import TrainingView


@pytest.mark.parametrize(("asked", "given"), [(None, 64), (16, 16), (64, 64), (640, 64)])
def test_frames_are_shrunk_but_never_enlarged(asked, given):
    clip = read_clip(builtin_clip(AnnyBody(), SceneConfig.tiny()), width=asked)
    assert clip.cameras[0].width == given
    assert clip[0].image.shape[1] == given


def test_resized_images_are_kept_within_a_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clip_values, "CACHE_MB", 0)
    store = small_clip().resized(16).store
    assert isinstance(store, clip_values.ResizedStore)
    for position in range(3):
        assert store.image(position).shape == (16, 16, 3)
    assert store._images.cached_bytes == 0


def test_a_training_view_has_its_pixels_row_by_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """However a reader's images lie in memory: kernels of the loss read their bytes."""
    clip = small_clip().resized(16)
    assert clip[0].image.is_contiguous()
    whole = clip_values.ResizedStore.image

    def planes(store: clip_values.ResizedStore, position: int) -> torch.Tensor:
        return whole(store, position).permute(2, 0, 1).contiguous().permute(1, 2, 0)

    monkeypatch.setattr(clip_values.ResizedStore, "image", planes)
    frame = clip[0]
    assert not frame.image.is_contiguous()
    image = TrainingView.of(frame, "cpu").frame.image
    assert image.is_contiguous() and torch.equal(image, frame.image)
