"""A person without a head in view: the square that shows them is found and followed."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace as Box

import numpy as np
import pytest

from hoigs.plugins.estimators.mediapipe import mediapipe_doubts
from hoigs.plugins.estimators.mediapipe.mediapipe_doubts import FEW, FOUND, OFF, SMALL, doubt

# as the script imports them, which knows nothing of hoigs
sys.path.append(str(Path(mediapipe_doubts.__file__).parent))
AGAIN, GuidedPose, seen_in = (
    getattr(importlib.import_module("mediapipe_guided"), name)
    for name in ("AGAIN", "GuidedPose", "seen_in")
)
Check = importlib.import_module("mediapipe_check").Check

IMAGE = np.zeros((90, 160, 3), np.uint8)
# nose, shoulders, elbows, wrists, hips of someone cut off at the neck, pixels
PLACES = {0: (80, -10), 11: (110, 10), 12: (50, 10), 13: (120, 40), 14: (40, 40), 15: (118, 60),
          16: (42, 60), 23: (95, 70), 24: (65, 70)}  # fmt: skip


class Graph:
    """Sees the person best in squares whose middle is at half of the image's height."""

    def __init__(self, narrow: float = 1.0, turned: bool = False) -> None:
        self.narrow, self.turned, self.looks = narrow, turned, 0
        self.places = dict(PLACES)

    def process(self, given: dict) -> Box:
        self.looks += 1
        sure = 1.0 if abs(given["square"].y_center - 0.5) < 0.1 else 0.7
        points = [Box(x=-1.0, y=-1.0, z=0.0, visibility=0.0) for _ in range(33)]
        for mark, (x, y) in self.places.items():
            x, y = 80 + (x - 80) * self.narrow, 89 - y if self.turned else y
            points[mark] = Box(x=x / 160, y=y / 90, z=0.0, visibility=sure)
        rows = Box(landmark=points)
        return Box(landmarks=rows, world=rows, mask=np.ones((90, 160), np.float32))


def guided(graph: Graph) -> GuidedPose:
    return GuidedPose(graph, Box, Check(graph, Box))


def test_the_best_square_is_followed() -> None:
    graph = Graph()
    pose = guided(graph)
    points, _, mask, _ = pose.process(IMAGE, None)
    np.testing.assert_allclose(points[11], (110, 10, 0, 1), atol=1e-9)
    assert not points[0, 3]  # what is out of view is not seen
    assert mask.shape == IMAGE.shape[:2] and pose.square[1] == pytest.approx(45)
    tried = graph.looks
    pose.process(IMAGE, None)
    assert graph.looks == tried + 2  # the picture and the mirrored one


def test_whoever_is_found_late_is_followed_back_until_they_are_not_seen() -> None:
    graph = Graph()
    pose = guided(graph)
    pose.process(IMAGE, None)
    square = pose.square

    def before():
        graph.places = {mark: (x, y + 3) for mark, (x, y) in PLACES.items()}
        yield IMAGE, None
        graph.turned = True
        yield IMAGE, None
        pytest.fail("the person was lost in the frame after this one")

    shown = [points[11, 1] for points, *_ in pose.earlier(before())]
    assert shown == pytest.approx([13])
    assert pose.square == square and pose.shoulders[0].tolist() == pytest.approx([110, 10])


def test_a_part_of_the_person_is_not_taken_for_the_whole() -> None:
    graph = Graph()
    pose = guided(graph)
    pose.process(IMAGE, None)
    graph.narrow = 0.7
    points, _, mask, why = pose.process(IMAGE, None)
    assert np.isnan(points).all() and mask.all() and why == mediapipe_doubts.NARROW
    graph.narrow, graph.turned = 1.0, True
    assert pose.process(IMAGE, None)[3] == mediapipe_doubts.TURNED


def test_nobody_who_stands_on_their_head_and_no_search_in_every_frame() -> None:
    graph = Graph(turned=True)
    pose = guided(graph)
    assert [pose.process(IMAGE, None) for _ in range(AGAIN + 1)] == [None] * (AGAIN + 1)
    assert graph.looks == 16


def test_a_guess_of_the_head_chooses_a_square_and_does_not_end_it() -> None:
    graph = Graph()
    pose = guided(graph)
    pose.process(IMAGE, None)
    graph.places[0] = (80, 20)  # out of view, guessed below the shoulders
    points, _, _, _ = pose.process(IMAGE, None)
    np.testing.assert_allclose(points[11, :2], (110, 10), atol=1e-9)
    assert guided(graph).process(IMAGE, None) is None


def test_the_mask_of_people_has_a_say_until_somebody_is_found() -> None:
    elsewhere, here = np.zeros((90, 160), np.float32), np.ones((90, 160), np.float32)
    elsewhere[:, :20] = 1
    assert guided(Graph()).process(IMAGE, elsewhere) is None
    pose = guided(Graph())
    pose.process(IMAGE, here)
    points, _, _, _ = pose.process(IMAGE, elsewhere)
    assert np.isfinite(points).all()


class Lopsided(Graph):
    """Sees the same pose in every picture, mirrored or not, `aside` pixels off the middle."""

    def __init__(self, aside: int) -> None:
        super().__init__()
        self.places = {mark: (x + aside, y) for mark, (x, y) in PLACES.items()}


@pytest.mark.parametrize(("aside", "person"), [(0, True), (3, True), (8, False)])
def test_who_is_a_person_in_the_mirror_too(aside: int, person: bool) -> None:
    """The shoulders are 60 pixels apart, and the mirrored pose is 2 x `aside` off."""
    graph = Lopsided(aside)
    pose = guided(graph)
    assert (pose.process(IMAGE, None) is not None) == person
    assert graph.looks == 20  # 16 squares, and the mirrored pictures of the best
    if person:  # followed while the pose in the mirror is at most twice as far off
        for more, fate in ((0, mediapipe_doubts.SQUARE), (10, mediapipe_doubts.UNLIKE)):
            graph.places = {mark: (x + more, y) for mark, (x, y) in graph.places.items()}
            assert [pose.process(IMAGE, None)[3] for _ in range(3)] == [fate] * 3


class Distracted(Graph):
    """Takes a thing before the chest for the head in the square it is shown first: the shoulders
    slip down, and are elsewhere in the mirror. A wider square shows the person."""

    distracted = False

    def process(self, given: dict) -> Box:
        found = super().process(given)
        mirrored = given["image"][0, 0, 0] == 255
        if self.distracted and given["square"].width * 160 < 1.15 * self.side:
            for mark in (11, 12):
                found.landmarks.landmark[mark].y += 0.1
                found.landmarks.landmark[mark].x += 0.3 if mirrored else 0.1
        return found


def test_a_wider_square_is_followed_where_a_thing_distracts() -> None:
    graph = Distracted()
    pose = guided(graph)
    picture = IMAGE.copy()
    picture[0, -1] = 255  # the first pixel of the mirrored picture
    pose.process(picture, None)
    graph.side, graph.distracted = pose.square[2], True
    points, _, _, why = pose.process(picture, None)
    assert why == mediapipe_doubts.SQUARE
    np.testing.assert_allclose(points[[11, 12], :2], [PLACES[11], PLACES[12]], atol=1e-9)
    looks = graph.looks
    pose.process(picture, None)
    assert graph.looks == looks + 2  # the wider square is the first one tried now


def test_left_and_right_are_treated_alike() -> None:
    """The graph has the same places for a picture and for the mirrored one, left of the middle."""
    square = (80.0, 45.0, 90.0)
    for aside, alike in ((2, True), (8, False)):
        graph = Lopsided(aside)
        points, space, _ = seen_in(graph, Box, IMAGE, square)
        _, flat, even = Check(graph, Box).seen(IMAGE, points, space, square)
        if alike:
            assert flat[[0, 11, 12], 0].tolist() == pytest.approx([80, 110, 50])
            assert even[[0, 11, 12], 0].tolist() == pytest.approx([0, 30 / 160, -30 / 160])
            np.testing.assert_array_equal(even[:, 1:], space[:, 1:])
        else:  # two poses that differ have no mean
            np.testing.assert_array_equal(even, space)
            np.testing.assert_array_equal(flat, points)


def square(*places: slice) -> np.ndarray:
    mask = np.zeros((90, 160), np.float32)
    for k in range(0, len(places), 2):
        mask[places[k], places[k + 1]] = 1
    return mask


def spread(low: float, high: float, x: float = 50.0, seen: int = 33) -> np.ndarray:
    points = np.zeros((33, 4))
    points[:, 0], points[:, 1] = x, np.linspace(low, high, 33)
    points[:seen, 3] = 0.9
    return points


@pytest.mark.parametrize(
    ("points", "own", "wide", "why"),
    [
        # the mask of people lacks head and chest, or all of them; it has furniture
        (spread(5, 80), square(slice(0, 90), slice(40, 60)), square(slice(60, 90), slice(160)),
         FOUND),
        (spread(5, 80), square(slice(0, 90), slice(40, 60)), square(slice(90), slice(90, 160)),
         FOUND),
        # arms raised to the head, the rest out of view: close together on a large mask
        (spread(5, 20), square(slice(0, 90), slice(30, 70)), square(slice(90), slice(30, 70)),
         FOUND),
        # a mug in the hand of somebody
        (spread(60, 70), square(slice(55, 75), slice(45, 60)), square(slice(90), slice(30, 90)),
         SMALL),
        (spread(5, 80), square(slice(0, 90), slice(90, 120)), square(slice(90), slice(40, 60)),
         OFF),
        (spread(5, 80, seen=3), square(slice(0, 90), slice(40, 60)), None, FEW),
        (spread(5, 80), None, None, FOUND),
    ],
)  # fmt: skip
def test_landmarks_are_held_against_their_own_mask(points, own, wide, why) -> None:
    assert doubt(points, own, wide) == why
