"""Person and object taken apart: by the silhouette, by colour, and when the silhouette is off."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.preparation.masks import MaskStack
from hoigs.preparation.separate import ColorOdds, separate

WIDTH, HEIGHT, F = 90, 120, 6


def scene(frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, person and object: a dark person, a blue bag that swings in front of the leg."""
    rng = np.random.default_rng(frame)
    image = np.full((HEIGHT, WIDTH, 3), 150, np.uint8)
    person = np.zeros((HEIGHT, WIDTH), bool)
    person[10:110, 25:45] = True
    person[40:50, 45:60] = True  # an arm
    thing = np.zeros_like(person)
    left = 52 - 3 * frame
    thing[50:85, left : left + 22] = True
    person &= ~thing
    image[person] = (35, 35, 40)
    image[thing] = (90, 105, 135)
    noise = rng.integers(-12, 13, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8), person, thing


def silhouettes(shift: int = 0) -> MaskStack:
    """The unclothed body, thinner than the person; in frame 2 it is `shift` pixels off."""
    stack = MaskStack()
    for frame in range(F):
        body = np.zeros((HEIGHT, WIDTH), bool)
        body[12:108, 28:42] = True
        body[42:48, 42:58] = True
        stack.append(np.roll(body, shift if frame == 2 else 0, axis=1))
    return stack


@pytest.mark.parametrize("shift", [0, -22])
def test_masks_are_found_and_share_out_the_whole(shift: int) -> None:
    together = MaskStack(scene(i)[1] | scene(i)[2] for i in range(F))
    human, thing = separate(lambda: (scene(i)[0] for i in range(F)), together, silhouettes(shift))
    for i in range(F):
        _, true_human, true_thing = scene(i)
        np.testing.assert_array_equal(human[i] ^ thing[i], together[i])
        assert (human[i] & true_human).sum() / (human[i] | true_human).sum() > 0.93
        assert (thing[i] & true_thing).sum() / (thing[i] | true_thing).sum() > 0.9


def test_colours_alone() -> None:
    image, person, thing = scene(0)
    colors = ColorOdds()
    colors.learn(image, thing, person)
    colors.settle()
    odds = colors(image)
    assert (odds[thing] > 0.5).mean() > 0.95 and (odds[person] < -0.5).mean() > 0.95
    unknown = np.full((2, 2, 3), (250, 10, 10), np.uint8)
    np.testing.assert_allclose(colors(unknown), 0, atol=1e-6)


def test_without_anything_to_learn_from_colours_say_nothing() -> None:
    image, person, _ = scene(0)
    colors = ColorOdds()
    colors.learn(image, np.zeros_like(person), person)
    colors.settle()
    assert not colors(image).any()
