"""train.width shrinks frames and never enlarges them."""

from __future__ import annotations

import pytest
from small_clip import small_clip

from hoigs.core.values import clip as clip_values
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.runs.clip_source import read_clip
from hoigs.synthesis import SceneConfig, builtin_clip


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
