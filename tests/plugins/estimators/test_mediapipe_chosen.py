"""Of two people the one who was clicked on is followed, forwards and backwards in time."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from types import SimpleNamespace as Box

import numpy as np
import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import EntityRequest, PromptPoint, VideoRequest
from hoigs.plugins.estimators import mediapipe

WIDTH, HEIGHT, LEFT, RIGHT = 320, 180, 60, 200
MARKS = {11: (12, -30), 12: (-12, -30), 13: (20, 0), 14: (-20, 0), 15: (20, 20), 16: (-20, 20),
         23: (8, 20), 24: (-8, 20), 27: (8, 60), 28: (-8, 60)}  # fmt: skip


class Graph:
    """Two people of which it finds the one nearer to the square's middle, as sure as it covers
    them; the image's first value is how far both have walked to the right."""

    def process(self, given: dict) -> Box:
        image, square = given["image"], given["square"]
        walked = int(image[0, 0, 0])
        middle = square.x_center * WIDTH
        x0 = min((LEFT + walked, RIGHT + walked), key=lambda x: abs(x - middle))
        points = [Box(x=-1.0, y=-1.0, z=0.0, visibility=0.0) for _ in range(33)]
        for mark, (x, y) in MARKS.items():
            inside = abs(x0 + x - middle) < square.width * WIDTH / 2
            points[mark] = Box(x=(x0 + x) / WIDTH, y=(90 + y) / HEIGHT, z=0.0, visibility=inside)
        mask = np.zeros((HEIGHT, WIDTH), np.float32)
        mask[50:160, x0 - 20 : x0 + 20] = 1
        rows = Box(landmark=points)
        return Box(landmarks=rows, world=rows, mask=mask)


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """As the script imports it, which knows nothing of hoigs."""
    monkeypatch.syspath_prepend(str(Path(mediapipe.__file__).parent))
    return importlib.import_module("mediapipe_chosen")


def image(walked: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), walked, np.uint8)


@pytest.mark.parametrize("start", [LEFT, RIGHT])
def test_the_one_clicked_on_is_followed(chosen: ModuleType, start: int) -> None:
    pose = chosen.ChosenPose(Graph(), Box, {0: ([(start + 40, 90, True)], None)}, back=4)
    walks = [40, 50, 60, 70, 30, 20]  # from frame 2 on forwards, then frames 1 and 0
    for number, walked in enumerate(walks):
        points, _, mask = pose.process(number, image(walked))
        assert points[[11, 12], 0].mean() == pytest.approx(start + walked)
        assert mask[90, start + walked] == 1


def test_a_click_on_nobody_is_refused(chosen: ModuleType) -> None:
    pose = chosen.ChosenPose(Graph(), Box, {0: ([(150, 90, True)], None)}, back=1)
    with pytest.raises(LookupError, match="there: 0"):
        pose.process(0, image(0))
    on, beside = ([(LEFT + 40, 90, True)], None), ([(150, 90, True)], None)
    pose = chosen.ChosenPose(Graph(), Box, {0: on, 1: beside}, back=2)
    pose.process(0, image(40))
    with pytest.raises(LookupError, match="there: 1"):  # a later one is not dropped, either
        pose.process(1, image(0))


def test_the_mask_needs_no_segmentation_of_the_whole_image(chosen: ModuleType) -> None:
    script = importlib.import_module("mediapipe_script")
    finder = object.__new__(script.Finder)
    finder.cv2 = Box(GaussianBlur=lambda image, *_: image)
    finder.close = Box(process=lambda cut: Box(segmentation_mask=np.ones(cut.shape[:2])))
    own, other = np.zeros((2, HEIGHT, WIDTH))
    own[50:160, 40:80], other[50:160, 180:220] = 1, 1
    mask = finder.of_one(image(0), other, own)
    np.testing.assert_array_equal(mask > 0.5, own > 0.5)


def video(*entities: EntityRequest) -> VideoRequest:
    folder = Path("nowhere")
    return VideoRequest(5, WIDTH, HEIGHT, image, folder, folder, entities=entities)


def test_frames_come_from_the_click_forwards_then_backwards() -> None:
    person = EntityRequest("human", "human", points=(PromptPoint(9, 8),), frame=2)
    order, sent = mediapipe._order(range(5), video(person))
    assert order == [2, 3, 4, 1, 0]
    assert sent == {"prompts": [[0, [[9, 8, True]], None]], "back": 3}
    assert mediapipe._order(range(5), video()) == ([0, 1, 2, 3, 4], None)
    with pytest.raises(HoigsError, match="frame 7"):
        mediapipe._order(range(5), video(replace(person, frame=7)))


def test_a_person_who_is_lost_is_worth_a_word() -> None:
    image = np.zeros((5, 33, 4), np.float32)
    assert mediapipe._lost([2, 3, 4, 1, 0], image) == ()
    image[[4, 1]] = np.nan
    (note,) = mediapipe._lost([2, 3, 4, 1, 0], image)
    assert "3 of 5 frames" in note and note.endswith("such as 4")
