"""train.width shrinks frames and never enlarges them."""

from __future__ import annotations

import pytest

from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis import SceneKnobs, builtin_clip
from hoigs.training.session import read_clip


@pytest.mark.parametrize(("asked", "given"), [(None, 64), (16, 16), (64, 64), (640, 64)])
def test_frames_are_shrunk_but_never_enlarged(asked, given):
    clip = read_clip(builtin_clip(AnnyBody(), SceneKnobs.tiny()), width=asked)
    assert clip.cameras[0].width == given
    assert clip[0].image.shape[1] == given
