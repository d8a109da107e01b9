"""Person and object taken apart: by the silhouette, by colour, and when the silhouette is off."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from hoigs.preparation.final_masks import ColorOdds, _adopted, _without_strays, separate
from hoigs.preparation.mask_stack import MaskStack

WIDTH, HEIGHT, F = 90, 120, 6
ALL = np.ones(F, bool)


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
    human, thing = separate(
        lambda: (scene(i)[0] for i in range(F)), together, silhouettes(shift), ALL
    )
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


def test_large_frames_are_worked_on_small_and_keep_their_sharp_outer_border() -> None:
    factor = 6  # 540 x 720: more than the 480 that are worked on

    def large(mask: np.ndarray) -> np.ndarray:
        return mask.repeat(factor, 0).repeat(factor, 1)

    together = MaskStack(large(scene(i)[1] | scene(i)[2]) for i in range(F))
    bodies = MaskStack(large(b) for b in silhouettes())
    human, thing = separate(lambda: (large(scene(i)[0]) for i in range(F)), together, bodies, ALL)
    for i in range(F):
        true_thing = large(scene(i)[2])
        assert thing[i].shape == true_thing.shape
        np.testing.assert_array_equal(human[i] ^ thing[i], together[i])
        assert (thing[i] & true_thing).sum() / (thing[i] | true_thing).sum() > 0.9


def test_a_frame_whose_body_was_not_seen_is_told_by_colour() -> None:
    """The silhouette of frame 2 is a guess that lies far off: the arm and the leg are no bag."""
    together = MaskStack(scene(i)[1] | scene(i)[2] for i in range(F))
    seen = ALL.copy()
    seen[2] = False
    bodies = silhouettes(shift=40)
    human, thing = separate(lambda: (scene(i)[0] for i in range(F)), together, bodies, seen)
    _, true_human, true_thing = scene(2)
    assert (human[2] & true_human).sum() / true_human.sum() > 0.97
    assert (thing[2] & true_thing).sum() / true_thing.sum() > 0.9


def test_what_strays_is_not_the_object() -> None:
    frames = []
    for i in range(9):
        mask = np.zeros((HEIGHT, WIDTH), bool)
        if i != 4:
            mask[60:80, 40:60] = True
        mask[2:8, 2:8] = i in (3, 4)
        frames.append(mask)
    kept = list(_without_strays(frames))
    assert not kept[4].any() and not kept[3][2:8, 2:8].any()
    assert all(kept[i][60:80, 40:60].all() for i in range(9) if i != 4)


def test_crumbs_of_the_person_on_the_object_are_the_objects() -> None:
    thing = np.zeros((HEIGHT, WIDTH), bool)
    thing[50:80, 50:80] = True
    thing[60:63, 60:63] = False  # a buckle of the person's colour
    whole = thing.copy()
    whole[60:63, 60:63] = whole[10:100, 10:48] = whole[5:8, 70:73] = True
    (kept,) = _adopted([thing], [whole])
    assert kept[50:80, 50:80].all()
    assert not kept[10:100, 10:48].any() and not kept[5:8, 70:73].any()


def test_memory_does_not_grow_with_the_frames() -> None:
    peaks = {}
    for frames in (6, 36):
        together = MaskStack(scene(i % F)[1] | scene(i % F)[2] for i in range(frames))
        bodies = MaskStack(silhouettes()[i % F] for i in range(frames))
        tracemalloc.start()
        separate(
            lambda count=frames: (scene(i % F)[0] for i in range(count)),
            together, bodies, np.ones(frames, bool), rounds=2,
        )  # fmt: skip
        peaks[frames] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    grown = (peaks[36] - peaks[6]) / 30
    assert grown < WIDTH * HEIGHT  # bytes a frame: less than one mask, let alone pixels
