"""estimator:object-tracker on small pictures of a textured disc, a person and a textured wall."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from disc_world import (
    COUNT,
    RADIUS,
    H,
    W,
    click,
    masks_of,
    overlaps,
    places,
    request,
    texture,
    world,
)

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    FramePrompt,
    Landmarks,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.footage import Footage, lab_of
from hoigs.plugins.estimators.object_tracker.path import _cheapest
from hoigs.plugins.estimators.object_tracker.proposal import Candidate, ranked, without_scenery
from hoigs.plugins.estimators.object_tracker.scene import MovingScene
from hoigs.plugins.estimators.object_tracker.states import DOUBTFUL, SEEN


@pytest.mark.parametrize("pan", [0.0, 1.5])
def test_one_click_follows_a_disc_past_a_person(tmp_path: Path, pan: float) -> None:
    scene = world(pan)
    found = masks_of(request(tmp_path, scene, (click(3),)))
    assert overlaps(found, scene[2]).mean() > 0.8
    assert overlaps(found, scene[2]).min() > 0.6
    assert (found.confidence["object"] > 0.5).all()


def test_without_a_prompt_the_moving_disc_is_proposed(tmp_path: Path) -> None:
    scene = world()
    found = masks_of(request(tmp_path, scene))
    on_thing(found, scene[2])
    assert overlaps(found, scene[2]).mean() > 0.8


def test_a_disc_that_is_hidden_for_some_frames_is_found_again(tmp_path: Path) -> None:
    scene = world(hidden=range(6, 9))
    found = masks_of(request(tmp_path, scene, (click(1),)))
    masks = found.entities["object"]
    assert not any(masks[i].any() for i in range(6, 9))
    assert overlaps(found, scene[2])[10:].min() > 0.6
    assert any("not seen in 3 frames (6-8)" in note for note in found.notes)


def test_a_still_video_without_a_prompt_has_no_object(tmp_path: Path) -> None:
    frames, people, discs = world()
    found = masks_of(request(tmp_path, ([frames[0]] * COUNT, [people[0]] * COUNT, discs)))
    assert not any(found.entities["object"][i].any() for i in range(COUNT))
    assert "nothing was found that moves" in found.notes[0]


@pytest.mark.parametrize("prompt", ["click", "box"])
def test_a_held_thing_that_the_person_s_mask_takes_in(tmp_path: Path, prompt: str) -> None:
    """A segmenter calls what a person holds a part of them; a box there was an error, and a click
    gave a piece of the thing."""
    frames, people, _ = world()
    y, x = np.mgrid[:H, :W] + 0.5
    board = (np.abs(x - 50) < 10) & (np.abs(y - 44) < 7)
    halves = np.where((x < 50)[..., None], (230, 230, 220), (220, 90, 40))
    for image, person in zip(frames, people, strict=True):
        image[board] = halves[board]
        person |= board
    box = (39.0, 36.0, 61.0, 52.0) if prompt == "box" else None
    points = (PromptPoint(52, 44),) if prompt == "click" else ()
    scene = frames, people, [board] * COUNT
    found = masks_of(request(tmp_path, scene, (FramePrompt(0, points, box),)))
    assert overlaps(found, scene[2])[0] > 0.9 and overlaps(found, scene[2]).mean() > 0.85


def test_a_click_on_the_wall_is_doubted_and_one_on_the_disc_is_not(tmp_path: Path) -> None:
    for place, doubted in ((click(0, 90, 60), True), (click(3), False)):
        found = masks_of(request(tmp_path / str(place.frame), world(), (place,)))
        assert any("looks like a part of the scene" in note for note in found.notes) is doubted
        states = set(
            found.states["object"]
        )  # the masks of what may be the wall are verified nowhere
        assert (SEEN in states, DOUBTFUL in states) == (not doubted, doubted)


def test_a_thing_held_away_from_the_limbs_is_proposed_from_within_the_person_s_mask(
    tmp_path: Path,
) -> None:
    """A bag that never left the person's mask was no candidate, and nothing was proposed."""
    y, x = np.mgrid[:H, :W] + 0.5
    bag = (np.abs(x - 72) < 7) & (np.abs(y - 52) < 9)
    arm = (np.abs(x - 62) < 12) & (np.abs(y - 40) < 3)
    image = texture(0, (120, 130, 90))[:, :W].copy()
    person = (np.abs(x - 50) < 8) & (y > 14)
    image[person | arm] = (70, 80, 150)
    image[bag] = texture(1, (200, 60, 50))[:, :W][bag]
    scene = [image.astype(np.uint8)] * COUNT, [person | arm | bag] * COUNT, [bag] * COUNT
    found = masks_of(with_landmarks(request(tmp_path, scene), standing(wrist=(71.0, 40.0))))
    on_thing(found, scene[2])
    assert overlaps(found, scene[2]).mean() > 0.8


def on_thing(found: EntityMasks, things: list[np.ndarray]) -> None:
    """Every proposed click lies on it."""
    assert found.chosen["object"]
    for prompt in found.chosen["object"]:
        (point,) = prompt.points
        assert things[prompt.frame][int(point.y), int(point.x)]
    taken = found.chosen["object"][0]
    where = (
        f"what is at {taken.points[0].x:g},{taken.points[0].y:g} in frame {taken.frame} was taken"
    )
    assert where in found.notes[0]


def before_the_body(flag: bool = False, away: range = range(0)):
    """A yellow box before a person's belly, in their mask; `flag`: something waves far from them;
    `away`: frames in which their back is seen."""
    wall = texture(0, (120, 130, 90))[:, :W]
    y, x = np.mgrid[:H, :W] + 0.5
    body = ((np.abs(x - 50) < 10) & (y > 24)) | (np.hypot(x - 50, y - 18) < 5)
    frames, boxes = [], []
    for i in range(COUNT):
        image, shift = wall.copy(), 2 * np.sin(i)
        image[body] = texture(2, (70, 80, 150))[:, :W][body]
        box = (np.abs(x - 50 - shift) < 8) & (np.abs(y - 45) < 6) & (i not in away)
        image[box] = texture(1, (220, 190, 40))[:, :W][box]
        if flag:
            waves = np.hypot(x - 98, y - 14 - 4 * (i % 3)) < 6
            image[waves] = texture(3, (200, 60, 50))[:, :W][waves]
        frames.append(image.astype(np.uint8))
        boxes.append(box)
    return frames, [body] * COUNT, boxes


def with_hands_before_the_belly(video: VideoRequest) -> VideoRequest:
    points = standing(wrist=(57.0, 45.0))
    points[[16, 18, 20, 22], :2] = 43, 45
    return with_landmarks(video, points)


@pytest.mark.parametrize("flag", [False, True])
def test_a_thing_before_the_body_is_proposed_by_its_colours(tmp_path: Path, flag: bool) -> None:
    """It lies within the person's mask and within their limbs, and was no candidate. What waves
    far from the hands is not it. As clothes would, it never leaves the torso, so that no mask of it
    counts as seen; masks of a click do."""
    scene = before_the_body(flag)
    found = masks_of(with_hands_before_the_belly(request(tmp_path, scene)))
    on_thing(found, scene[2])
    assert overlaps(found, scene[2]).mean() > 0.75
    assert {*found.states["object"]} == {"doubtful"}
    box = FramePrompt(0, box=(42.0, 39.0, 58.0, 51.0))
    clicked = masks_of(with_hands_before_the_belly(request(tmp_path, scene, (box,))))
    assert clicked.states["object"].count("seen") > 0.7 * COUNT


def test_a_thing_that_the_body_hides_is_proposed_before_and_after(tmp_path: Path) -> None:
    """One click left it to the tracker to find it again."""
    scene = before_the_body(away=range(5, 9))
    found = masks_of(with_hands_before_the_belly(request(tmp_path, scene)))
    on_thing(found, scene[2])
    asked = [prompt.frame for prompt in found.chosen["object"]]
    assert min(asked) < 5 and max(asked) > 8
    masks = found.entities["object"]
    assert not any(masks[i].any() for i in range(5, 9))
    assert overlaps(found, scene[2])[[*range(5), *range(9, COUNT)]].mean() > 0.7


def test_what_no_hand_touches_and_stays_in_place_counts_less() -> None:
    """Edges of the scene that a moving camera's parallax sets off, beside a ball that is kicked."""

    steps = np.tile(np.eye(3), (10, 1, 1))
    steps[:, 0, 2] = 3
    panned = MovingScene(cast(Footage, None), steps)

    def seen(x: float, i: int, color: int, near: float) -> Candidate:
        return Candidate(i, (x, 40.0), 0.5, np.eye(4)[color], radius=2.0, near=near)

    edges = [seen(10 + 3 * i, i, 0, near=0.3) for i in range(10)]
    kicked = [seen(90 - 9 * i, i, 1, near=0.3) for i in range(10)]
    touched = [seen(60 + 3 * i, i, 2, near=1.0) for i in range(10)]
    found = without_scenery([*edges, *kicked, *touched], panned, slack=1.0)
    assert [c.score for c in found] == [0.0] * 10 + [0.5] * 20
    assert not [c for c in ranked(found, 10) if c.colors[0]]


def test_one_of_two_alike_does_not_become_the_other_while_it_is_away(tmp_path: Path) -> None:
    """The second disc rests at the right until it goes behind a board; the first passes by."""
    frames, people, discs = world()
    ball = texture(1, (200, 60, 50))
    y, x = np.mgrid[:H, :W] + 0.5
    others = []
    for i, image in enumerate(frames):
        cx, cy = (94, 14 + 2 * i) if i < 5 else (94, 58)
        other = np.hypot(x - cx, y - cy) < RADIUS if i < 5 or i > 9 else np.zeros((H, W), bool)
        image[other] = np.roll(ball[:, :W], (cy, cx), (0, 1))[other].astype(np.uint8)
        others.append(other & ~discs[i])
    points = {"object": places()[0], "other": (94.0, 14.0)}
    video = replace(
        request(tmp_path, (frames, people, discs)),
        entities=tuple(
            EntityRequest(name, "object", further=(FramePrompt(0, (PromptPoint(*at),)),))
            for name, at in points.items()
        ),
    )
    found = masks_of(video)
    theirs = [found.entities["other"][i] for i in range(COUNT)]
    assert not any((theirs[i] & discs[i]).sum() > 0.5 * discs[i].sum() for i in range(COUNT))
    assert overlaps(found, discs).mean() > 0.75


def standing(wrist: tuple[float, float]) -> np.ndarray:
    """MediaPipe's landmarks of the upright person of `world`, one arm stretched out: [33, 4]."""
    points = np.zeros((33, 4))
    points[:, 3] = 1
    points[:, :2] = 50, 18  # the head
    for rows, at in (
        ((11,), (54, 28)), ((12,), (46, 28)), ((23,), (53, 50)), ((24,), (47, 50)),
        ((13,), (60, 36)), ((15, 17, 19, 21), wrist), ((14,), (46, 38)),
        ((16, 18, 20, 22), (46, 48)),
        ((25,), (53, 60)), ((26,), (47, 60)), ((27, 29, 31), (53, 70)), ((28, 30, 32), (47, 70)),
    ):  # fmt: skip
        points[list(rows), :2] = at
    return points


def with_landmarks(video: VideoRequest, points: np.ndarray) -> VideoRequest:
    assert video.known is not None
    track = Landmarks(np.repeat(points[None], COUNT, 0))
    return replace(video, known=replace(video.known, landmarks={"human": track}))


def test_an_object_does_not_jump_to_a_thing_of_its_colours_that_was_always_there() -> None:
    """A moving thing that looks odd for some frames, and a still one elsewhere that looks right."""
    here, there = np.array([20.0, 20.0]), np.array([80.0, 20.0])

    def frames(still: bool) -> list:
        odd = [0.9 if 3 <= i < 8 else -0.5 for i in range(12)]
        first = (here[None], np.array([-4.0]), np.zeros(1, bool))
        later = [
            (
                np.stack((here + np.array((i, 0)), there)),
                np.array([cost, -0.2]),
                np.array([False, still]),
            )
            for i, cost in enumerate(odd)
        ]
        return [first, *later]

    assert _cheapest(frames(still=False), 10.0, [0]).centers[6, 0] == 80
    assert (_cheapest(frames(still=True), 10.0, [0]).centers[:, 0] < 40).all()


def test_a_path_from_a_known_place_does_not_begin_with_an_absence() -> None:
    """From which the object turned up, at no cost, in a picture on the wall of its colours."""
    here, there = np.array([20.0, 20.0]), np.array([80.0, 20.0])
    frames = [(here[None], np.array([-4.0]), np.zeros(1, bool))]
    for i in range(1, 14):
        places = np.stack((here + np.array((i, 0)), there))
        frames.append((places, np.array([0.3, -0.2]), np.array([False, True])))
    path = _cheapest(frames, 10.0, [0])
    assert path.seen.all() and (path.centers[:, 0] < 40).all()


def test_what_a_click_on_the_person_gives_is_noted_and_not_kept(tmp_path: Path) -> None:
    """It was kept, doubtful, and a training would have learnt a leg as the object."""
    found = masks_of(request(tmp_path, world(), (click(0, 50, 66),)))
    assert "lies on the person and has their colours" in found.notes[0]
    assert set(found.states["object"]) == {"lost"}
    assert not any(found.entities["object"][i].any() for i in range(COUNT))


def test_a_click_on_a_thing_that_the_persons_mask_takes_in_is_not_doubted(tmp_path: Path) -> None:
    frames, people, discs = world()
    taken = [person | disc for person, disc in zip(people, discs)]
    found = masks_of(request(tmp_path, (frames, taken, discs), (click(6),)))
    assert people[6].any() and not any("click" in note for note in found.notes)


def test_a_click_on_a_black_border_is_an_error_that_says_so(tmp_path: Path) -> None:
    frames, people, discs = world()
    for frame in frames:
        frame[:, 84:] = 0
    with pytest.raises(HoigsError, match=r"at 100,30 in frame 2: there is a black border"):
        masks_of(request(tmp_path, (frames, people, discs), (click(2, 100, 30),)))


def test_a_prompt_beyond_the_end_is_an_error(tmp_path: Path) -> None:
    prompt = FramePrompt(99, (PromptPoint(5, 5),))
    with pytest.raises(HoigsError, match="frame 99; the video has frames 0 to 13"):
        masks_of(request(tmp_path, world(), (prompt,)))


def test_results_are_kept_and_depend_on_the_prompt(tmp_path: Path) -> None:
    video = request(tmp_path, world(), (click(3),))
    first = masks_of(video).entities["object"][5]

    def unread(i: int) -> np.ndarray:
        raise AssertionError("the kept result is read")

    again = masks_of(replace(video, read=unread)).entities["object"][5]
    assert (first == again).all()
    masks_of(request(tmp_path, world(), (click(4),)))
    assert len(list(tmp_path.glob("object-tracker-*.npz"))) == 2
    assert not list(tmp_path.glob("*.part"))


def test_lab_of_known_colors() -> None:
    # sRGB red and white in CIE L*a*b* (D65): 53.2, 80.1, 67.2 and 100, 0, 0
    lab = lab_of(np.uint8([[[255, 0, 0], [255, 255, 255]]])).astype(float)
    assert np.allclose(lab[0, 0] / [2.55, 1, 1] - [0, 128, 128], (53.2, 80.1, 67.2), atol=0.6)
    assert np.allclose(lab[0, 1] / [2.55, 1, 1] - [0, 128, 128], (100, 0, 0), atol=0.6)
