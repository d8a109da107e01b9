"""Of two people the one who was clicked on is followed, forwards and backwards in time."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from types import SimpleNamespace as Box

import numpy as np
import pytest
from tiny_mediapipe import FAKE_CV2

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import EntityRequest, PromptPoint, VideoRequest
from hoigs.plugins.estimators.mediapipe import estimator as mediapipe

WIDTH, HEIGHT, LEFT, RIGHT = 320, 180, 60, 200
MARKS = {11: (12, -30), 12: (-12, -30), 13: (20, 0), 14: (-20, 0), 15: (20, 20), 16: (-20, 20),
         23: (8, 20), 24: (-8, 20), 27: (8, 60), 28: (-8, 60)}  # fmt: skip


def guesses(x0: int) -> list[Box]:
    """33 landmarks that are not seen, on the person: the network supposes a place of all."""
    return [Box(x=x0 / WIDTH, y=0.25 + (i > 10) / 4, z=0.0, visibility=0.0) for i in range(33)]


class Graph:
    """Two people of which it finds the one nearer to the square's middle, as sure as it covers
    them; the image's first value is how far both have walked to the right."""

    def process(self, given: dict) -> Box:
        image, square = given["image"], given["square"]
        walked = int(image[0, 0, 0])
        middle = square.x_center * WIDTH
        x0 = min((LEFT + walked, RIGHT + walked), key=lambda x: abs(x - middle))
        points = guesses(x0)
        for mark, (x, y) in MARKS.items():
            inside = abs(x0 + x - middle) < square.width * WIDTH / 2
            points[mark] = Box(x=(x0 + x) / WIDTH, y=(90 + y) / HEIGHT, z=0.0, visibility=inside)
        mask = np.zeros((HEIGHT, WIDTH), np.float32)
        mask[50:160, x0 - 20 : x0 + 20] = 1
        rows = Box(landmark=points)
        return Box(landmarks=rows, world=rows, mask=mask)


@pytest.fixture
def people(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """As the script imports it, which knows nothing of hoigs."""
    monkeypatch.syspath_prepend(str(Path(mediapipe.__file__).parent))
    return importlib.import_module("mediapipe_people")


def image(walked: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), walked, np.uint8)


@pytest.mark.parametrize("start", [LEFT, RIGHT])
def test_the_one_clicked_on_is_followed(people: ModuleType, start: int) -> None:
    prompts = {"anna": {2: ([(start + 40, 90, True)], None)}}
    found = people.People(Graph(), Box, prompts, [2, 3, 4, 5, 1, 0], back=4)
    walks = [40, 50, 60, 70, 30, 20]  # from frame 2 on forwards, then frames 1 and 0
    for place, walked in enumerate(walks):
        points, _, mask = found.process(place, image(walked))["anna"]
        assert points[[11, 12], 0].mean() == pytest.approx(start + walked)
        assert mask[90, start + walked] == 1


def test_a_click_on_nobody_is_refused(people: ModuleType) -> None:
    nobody = {"anna": {3: ([(150, 90, True)], None)}}
    with pytest.raises(LookupError, match="there: 3 of anna"):
        people.People(Graph(), Box, nobody, [3], back=1).process(0, image(0))
    later = {"anna": {0: ([(LEFT + 40, 90, True)], None), 1: nobody["anna"][3]}}
    found = people.People(Graph(), Box, later, [0, 1], back=2)
    found.process(0, image(40))
    with pytest.raises(LookupError, match="there: 1"):  # a later one is not dropped, either
        found.process(1, image(0))


class Crossing:
    """Two people in red and blue who walk towards each other; the one in red is in front."""

    def __init__(self) -> None:
        self.sides = (50, 270)

    def draw(self, frame: int) -> np.ndarray:
        self.places = (50 + 10 * frame, 270 - 10 * frame)
        drawn = image(120)
        for x, color in ((self.places[1], (10, 10, 250)), (self.places[0], (250, 10, 10))):
            drawn[50:160, max(0, x - 20) : x + 20] = color
        return drawn

    def process(self, given: dict) -> Box:
        middle = given["square"].x_center * WIDTH
        red, blue = self.places
        x0 = min(self.places, key=lambda x: abs(x - middle))
        x0 = red if abs(red - blue) < 25 else x0  # the other one is hidden
        points = guesses(x0)
        for mark, (x, y) in MARKS.items():
            points[mark] = Box(x=(x0 + x) / WIDTH, y=(90 + y) / HEIGHT, z=0.0, visibility=0.9)
        mask = np.zeros((HEIGHT, WIDTH), np.float32)
        mask[50:160, max(0, x0 - 20) : x0 + 20] = 1
        rows = Box(landmark=points)
        return Box(landmarks=rows, world=rows, mask=mask)


def test_people_who_cross_stay_themselves(people: ModuleType) -> None:
    graph, order = Crossing(), [*range(21), *reversed(range(4))]
    prompts = {"red": {0: ([(50, 90, True)], None)}, "blue": {4: ([(230, 90, True)], None)}}
    found = people.People(graph, Box, prompts, order, back=21)
    for place, frame in enumerate(order):
        seen = found.process(place, graph.draw(frame))
        passes = {"red"} if frame < 4 and place < 21 else {"red", "blue"}
        assert set(seen) == (passes if place < 21 else {"blue"})
        hidden = abs(graph.places[0] - graph.places[1]) < 25
        for name, x in zip(("red", "blue"), graph.places, strict=True):
            if name == "blue" and hidden:
                assert seen[name] is None
            elif name in seen:
                assert seen[name][0][[11, 12], 0].mean() == pytest.approx(x)


def test_people_without_a_face_are_looked_for(people: ModuleType) -> None:
    module = importlib.import_module("mediapipe_look")
    look = object.__new__(module.Look)
    look.landmarks = (Graph(), Box)
    look.real = lambda *_: True  # the graph above sees nothing mirrored
    found = look.faceless(image(0), [])
    assert sorted(round(x / 10) for _, x, _, _ in found) == pytest.approx([6, 20], abs=4)
    assert all(sure < 0.6 for sure, *_ in found)
    (other,) = look.faceless(image(0), [(0.9, float(LEFT), 90.0, 150.0)])
    assert abs(other[1] - RIGHT) < 40


def test_several_people_are_those_of_the_frame_that_shows_most() -> None:
    rows = [(0, 0.9, 50, 90, 100), (1, 0.8, 60, 90, 100), (1, 0.9, 200, 90, 100)]
    seen = np.array([*rows, (2, 0.7, 60, 90, 100), (2, 0.7, 200, 90, 100)], np.float32)
    first, second = mediapipe._together(seen, [5, 6, 7], video())
    assert first.frame == second.frame == 6 and first.box == (160, 50, 240, 130)
    (alone,) = mediapipe._together(seen[:3], [5, 6], video())  # two people once: one is a coat
    assert alone.frame in (5, 6)
    assert mediapipe._together(np.zeros((0, 5), np.float32), [5], video()) == ()


def test_clicks_on_two_people_are_not_one_person(people: ModuleType) -> None:
    graph = Crossing()
    clicks = {"red": {0: ([(50, 90, True)], None), 3: ([(240, 90, True)], None)}}
    found = people.People(graph, Box, clicks, [0, 1, 2, 3], back=4)
    for place in range(3):
        found.process(place, graph.draw(place))
    with pytest.raises(LookupError, match="someone else is there: 3 of red"):
        found.process(3, graph.draw(3))
    assert "name the other: --person anna=X,Y@3" in mediapipe._misplaced(
        "someone else is there: 3 of red"
    )


def refined(own: np.ndarray, wide: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The person's mask from that of the pose, of the whole image, and of its part about them."""
    script = importlib.import_module("mediapipe_script")
    finder = object.__new__(script.Finder)
    finder.cv2 = ModuleType("cv2")
    exec(FAKE_CV2, vars(finder.cv2))
    finder.near = lambda _image, _inside: near
    found: np.ndarray = finder.of_one(image(0), wide, own) > 0.5
    return found


def test_the_mask_needs_no_segmentation_of_the_whole_image(people: ModuleType) -> None:
    own, other = np.zeros((2, HEIGHT, WIDTH), np.float32)
    own[50:160, 40:80], other[50:160, 180:220] = 1, 1
    np.testing.assert_array_equal(refined(own, other, own), own > 0.5)


def test_segmentations_of_selfies_move_the_outline_of_the_pose_s_own_mask(
    people: ModuleType,
) -> None:
    own, selfies = np.zeros((2, HEIGHT, WIDTH), np.float32)
    own[20:50, 50:70] = own[50:160, 40:80] = own[60:64, 80:110] = 1  # head, body, a thin arm
    selfies[50:160, 42:82] = selfies[150:165, 100:140] = 1  # of body and chair, 2 pixels aside
    found = refined(own, selfies, selfies)
    assert found[70:150, 42:82].all() and not found[70:150, 38:42].any()
    assert found[20:46, 50:70].all() and found[60:64, 84:110].all()  # they lack head and arm
    assert not found[:, 112:].any()


def video(*entities: EntityRequest) -> VideoRequest:
    folder = Path("nowhere")
    return VideoRequest(5, WIDTH, HEIGHT, image, folder, folder, entities=entities)


def test_frames_come_from_the_click_forwards_then_backwards() -> None:
    anna = EntityRequest("anna", "human", points=(PromptPoint(9, 8),), frame=2)
    ben = replace(anna, name="ben", frame=4)
    order, sent = mediapipe._order(range(5), video(anna))
    assert order == [2, 3, 4, 1, 0]
    assert sent["prompts"] == {"anna": [[2, [[9, 8, True]], None]]} and sent["back"] == 3
    order, sent = mediapipe._order(range(5), video(anna, ben))
    assert order == [2, 4, 2, 3, 4, 3, 2, 1, 0] and list(sent["prompts"]) == ["anna", "ben"]
    assert (sent["shown"], sent["back"]) == (2, 5)
    assert mediapipe._order(range(5), video()) == ([0, 1, 2, 3, 4], None)
    with pytest.raises(HoigsError, match="frame 7"):
        mediapipe._order(range(5), video(replace(anna, frame=7)))
    with pytest.raises(HoigsError, match="who ben is: click on each"):
        mediapipe._order(range(5), video(anna, EntityRequest("ben", "human")))


def test_a_person_who_is_lost_is_worth_a_word() -> None:
    image = np.zeros((5, 33, 4), np.float32)
    assert mediapipe._lost(range(5), {"anna": image}) == ()
    image[[4, 1]] = np.nan
    (note,) = mediapipe._lost(range(5), {"anna": image})
    assert "3 of 5 frames" in note and note.endswith("such as 1")
    (note,) = mediapipe._lost(range(5), {"anna": image, "ben": np.zeros_like(image)})
    assert note.startswith("anna was followed in 3")
