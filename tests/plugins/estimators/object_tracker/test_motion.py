"""What moves together, which tells a thing from what it is before where colours do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from disc_world import H, W, texture
from scipy import ndimage
from test_behind import footage_of

from hoigs.core.interfaces.estimator import FramePrompt, PromptPoint
from hoigs.plugins.estimators.object_tracker.motion import Motion
from hoigs.plugins.estimators.object_tracker.prompts import overlap, prompted_mask
from hoigs.plugins.estimators.object_tracker.scene import static_scene

Y, X = np.mgrid[:H, :W] + 0.5


def disc(x: float, radius: float = 14) -> np.ndarray:
    return np.hypot(X - x, Y - 36) < radius


def footage():
    """A disc of the wall's colours that moves 3 pixels a frame."""
    wall, ball = (texture(seed, (120, 130, 90))[:, :W] for seed in (0, 1))
    frames = []
    for i in range(5):
        image = wall.copy()
        image[disc(44 + 3 * i)] = np.roll(ball, 3 * i, 1)[disc(44 + 3 * i)]
        frames.append(image.astype(np.uint8))
    return footage_of(frames, [np.zeros((H, W), bool)] * 5)


def test_one_motion_sets_a_disc_off_from_a_wall_of_its_colours() -> None:
    motion = Motion.of(footage(), 2)
    shares, differences, found = np.array(
        [motion.sets_off(m).mean(0) for m in (disc(50), disc(50, 8), disc(50, 28), disc(90, 10))]
    ).T
    assert shares[0] > 0.5 and shares[0] > shares[1:].max() + 0.2
    assert differences[0] > differences[1:].max() + 0.3
    assert found[0] > 0.5


def test_motion_is_known_of_every_third_frame_and_not_of_every_twentieth() -> None:
    third, rare = (replace(footage(), numbers=tuple(range(0, 5 * n, n))) for n in (3, 20))
    assert Motion.of(third, 2).sets_off(disc(50)).mean(0)[0] > 0.5
    assert not len(Motion.of(rare, 2).sets_off(disc(50)))


def test_a_frame_alone_says_nothing_of_motion() -> None:
    one = footage()
    alone = footage_of([np.zeros((H, W, 3), np.uint8)], [one.person[0]])
    assert not len(Motion.of(alone, 0).sets_off(disc(50)))


@pytest.mark.parametrize("x, y", [(42, 28), (65, 42)])
def test_a_click_anywhere_on_a_thing_of_two_colours(x: float, y: float) -> None:
    """The middle of what is sought is the click at first, which is seldom the object's."""
    wall, tan = texture(0, (90, 110, 120))[:, :W], texture(1, (200, 170, 120))[:, :W]
    frames, things = [], []
    for i in range(8):
        middle = 12 + 14 * i
        mask = (np.abs(X - middle) < 18) & (np.abs(Y - 36) < 13)
        half = np.where((X - middle < 0)[..., None], tan - 60, tan)
        image = np.where(mask[..., None], half, wall)
        frames.append(ndimage.gaussian_filter(image, (0.5, 0.5, 0)).astype(np.uint8))
        things.append(mask)
    seen = footage_of(frames, [np.zeros((H, W), bool)] * 8)
    found = prompted_mask(seen, static_scene(seen), 3, FramePrompt(3, (PromptPoint(x, y),)))
    assert overlap(found.soft > 0.5, things[3]) > 0.8


def test_a_click_on_what_is_printed_on_a_box_finds_the_box() -> None:
    """Before a person, and the box is held still for the first frames."""
    shirt = (3 * (texture(0, (120, 130, 150))[:, :W] - 130) + 130).clip(0, 255)
    side, label = texture(1, (205, 200, 185))[:, :W], texture(2, (210, 70, 40))[:, :W]
    frames, boxes = [], []
    for i in range(16):
        moved = 2 * max(0, i - 3)
        box = (np.abs(X - 44 - moved) < 18) & (np.abs(Y - 36) < 14)
        drawn = np.where(disc(44, 6)[..., None], label, side)
        image = np.where(box[..., None], np.roll(drawn, moved, 1), shirt)
        frames.append(ndimage.gaussian_filter(image, (0.5, 0.5, 0)).astype(np.uint8))
        boxes.append(box)
    seen = footage_of(frames, [np.ones((H, W), bool)] * 16)
    found = prompted_mask(seen, static_scene(seen), 0, FramePrompt(0, (PromptPoint(44, 36),)))
    assert overlap(found.soft > 0.5, boxes[0]) > 0.8
