"""Objects outlined by a network: which of its masks is taken, and what becomes of those found."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from disc_world import H, W, click, masks_of, overlaps, request, world

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import FramePrompt, Landmarks
from hoigs.plugins.estimators.object_tracker import outlines
from hoigs.plugins.estimators.object_tracker.estimator import ObjectTrackerEstimator
from hoigs.plugins.estimators.object_tracker.footage import read_footage
from hoigs.plugins.estimators.object_tracker.outlined import clicked_mask
from hoigs.plugins.estimators.object_tracker.outlines import HIGH, INSIDE, LOW, Outlines
from hoigs.plugins.estimators.object_tracker.outlines_script import with_outputs
from hoigs.plugins.estimators.object_tracker.prompts import overlap
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.refined import Refined, refined
from hoigs.plugins.estimators.object_tracker.scene import static_scene
from hoigs.plugins.estimators.object_tracker.states import DOUBTFUL, SEEN, states_of
from hoigs.preparation.estimates.reader import identity


@pytest.fixture
def fake(monkeypatch) -> None:
    """A network that knows colours, run by this Python."""
    monkeypatch.setattr(outlines, "SCRIPT", Path(__file__).with_name("fake_network.py"))
    monkeypatch.setattr(Outlines, "installed", staticmethod(lambda: True))
    monkeypatch.setattr(outlines, "_command", lambda: [sys.executable, "-I", str(outlines.SCRIPT)])


def plain() -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """The disc of one colour before a wall of another."""
    _, people, discs = world()
    frames = [np.full((H, W, 3), (120, 130, 90), np.uint8) for _ in discs]
    for frame, person, disc in zip(frames, people, discs, strict=True):
        frame[person], frame[disc] = (70, 80, 150), (230, 60, 50)
    return frames, people, discs


def test_pixels_are_those_of_the_frame_whatever_is_looked_at(fake) -> None:
    frames, _, discs = plain()
    large = [np.kron(f, np.ones((3, 3, 1), np.uint8)) for f in frames]  # read at another size
    x, y = click(2).points[0].x, click(2).points[0].y
    for box in (None, (x - 20, y - 20, x + 24, y + 16), (x - 30, y - 60, x + 90, y + 60)):
        with Outlines((H, W), lambda i: large[i]) as network:
            network.look(2, box)
            (first, *_) = network.found([(x, y)], [INSIDE])
            by_box = network.found([(x - 9, y - 9), (x + 9, y + 9)], [LOW, HIGH])[0]
        assert overlap(first.mask, discs[2]) > 0.85, box
        assert np.array_equal(first.mask, by_box.mask) and first.quality == 0.9


def test_a_click_takes_what_the_network_outlines_there(fake, tmp_path) -> None:
    scene = plain()
    video = request(tmp_path, scene)
    footage = read_footage(video, scene[1])
    prompt = click(3, click(3).points[0].x + 4)
    x, y = click(3).points[0].x, click(3).points[0].y
    box = FramePrompt(3, (), (x - 9, y - 9, x + 9, y + 9))
    for asked in (prompt, box):
        with Outlines(footage.shape, video.frame) as network:
            found = clicked_mask(footage, static_scene(footage), 3, asked, None, network)
        assert overlap(found.soft > 0.5, scene[2][3]) > 0.85
        assert 0 < found.quality <= 1.5


def test_beside_the_picture_and_on_its_black_border_the_network_is_not_asked(
    fake, tmp_path
) -> None:
    scene = plain()
    for frame in scene[0]:
        frame[:12] = 0
    video = request(tmp_path, scene)
    footage = read_footage(video, scene[1])
    for x, y in ((W + 30.0, 20.0), (50.0, 5.0)):
        with Outlines(footage.shape, video.frame) as network:
            found = clicked_mask(footage, static_scene(footage), 3, click(3, x, y), None, network)
        assert not (found.soft > 0.5).any()


def test_followed_masks_are_outlined_again_where_the_network_sees_the_same(fake, tmp_path) -> None:
    scene = plain()
    video = request(tmp_path, scene)
    footage = read_footage(video, scene[1])
    soft = np.zeros((len(footage), H, W), np.uint8)
    rough = [np.roll(d, 3, 1) for d in scene[2]]
    for i in (1, 2, 3):
        soft[i][rough[i]] = 255
    soft[4][:4, :4] = 255  # of the wall, of which the network sees far more
    with Outlines(footage.shape, video.frame) as network:
        found = refined(footage, network, Track(soft, np.ones(len(footage))), ()).track.soft > 127
    for i in (1, 2, 3):
        assert overlap(found[i], scene[2][i]) > max(0.85, overlap(rough[i], scene[2][i]))
    assert np.array_equal(found[4], soft[4] > 127)
    assert not found[0].any()


def slowly() -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """The plain scene, in which the disc hardly moves."""
    frames, people, discs = plain()
    slow = [np.roll(discs[2], i // 2, 1) for i in range(len(discs))]
    for frame, disc, person in zip(frames, slow, people, strict=True):
        frame[:] = (120, 130, 90)
        frame[person & ~disc], frame[disc] = (70, 80, 150), (230, 60, 50)
    return frames, people, slow


def better_than(
    scene, video, soft: np.ndarray, clicked: tuple[int, ...], has_rivals: bool = False
) -> Refined:
    footage, track = read_footage(video, scene[1]), Track(soft, 0.8 * soft.any((1, 2)))
    with Outlines(footage.shape, video.frame) as network:
        return refined(footage, network, track, clicked, has_rivals)


def test_outlines_lead_on_from_masks_as_far_as_the_object_is_there(fake, tmp_path) -> None:
    frames, _, slow = scene = slowly()
    frames[9][:] = (120, 130, 90)  # it is gone for a moment
    soft = np.zeros((len(frames), H, W), np.uint8)
    for i in (1, 6, 11):
        soft[i][slow[i]] = 255
    better = better_than(scene, request(tmp_path, scene), soft, (6,))
    found = better.track.soft > 127
    for i in range(9):
        assert overlap(found[i], slow[i]) > 0.85, i
    assert not found[[9, 10, 12, 13]].any() and found[11].any()  # nothing leads to 11 from a click
    assert better.track.confidence[0] == 0.8
    assert np.array_equal(np.flatnonzero(better.led), np.arange(9))  # of the click in 6
    among_equals = better_than(scene, request(tmp_path, scene), soft, (6,), True).track.soft > 127
    assert np.array_equal(np.flatnonzero(among_equals.any((1, 2))), (1, 6, 11))


@pytest.mark.parametrize("hand", [True, False])
def test_what_a_hand_leaves_free_of_an_object_is_still_it_and_comes_back_whole(
    fake, tmp_path, hand: bool
) -> None:
    frames, people, slow = scene = slowly()
    x = np.arange(W)[None]
    for i in range(4, 9):
        left = np.flatnonzero(slow[i].any(0))[0]
        fingers = slow[i] & (x < left + 6)
        frames[i][fingers] = (205, 150, 125)
        people[i] = people[i] | (fingers & hand)
    soft = np.zeros((len(frames), H, W), np.uint8)
    for i in range(4):
        soft[i][slow[i]] = 255
    better = better_than(scene, request(tmp_path, scene), soft, (0,))
    if not hand:  # nobody is known to hide the rest
        assert not better.track.soft[4:].any() and not better.led[4:].any()
        return
    found = better.track.soft > 127
    for i in range(len(frames)):
        free = slow[i] & (frames[i] == (230, 60, 50)).all(-1)
        assert overlap(found[i], free) > 0.8, i
    assert better.led.all()


def test_a_mask_that_differs_from_those_beside_it_is_outlined_as_they_are(fake, tmp_path) -> None:
    scene = slowly()
    slow = scene[2]
    soft = np.stack(slow).astype(np.uint8) * 255
    soft[0, :60, :40] = 255  # the clicked mask takes in much of the wall
    soft[7, 4:9, 4:9] = 255  # and another one a spot far away
    better = better_than(scene, request(tmp_path, scene), soft, (0,))
    for i in (0, 7):
        assert overlap(better.track.soft[i] > 127, slow[i]) > 0.85
    assert not (better.track.soft[7, :20] > 127).any()
    assert better.led.all()


def test_a_click_on_what_is_held_takes_no_hand_of_like_colours(fake, tmp_path) -> None:
    frames, people, discs = plain()
    marks = np.zeros((len(frames), 33, 4), np.float32)
    for i, (frame, person, disc) in enumerate(zip(frames, people, discs, strict=True)):
        y, x = (round(float(v)) for v in np.argwhere(disc).mean(0))
        arm = np.zeros_like(disc)
        arm[y - 4 : y + 4, x : x + 40] = True
        frame[arm & ~disc] = (205, 100, 95)  # the network takes both for one thing
        person |= arm | disc
        marks[i, (14, 16), :2] = ((x + 36, y), (x + 16, y))
        marks[i, (14, 16), 3] = 1
    video = request(tmp_path, (frames, people, discs))
    known = replace(video.known, landmarks={"human": Landmarks(marks)})
    footage = read_footage(replace(video, known=known), people)
    x, y = click(3).points[0].x, click(3).points[0].y
    box = FramePrompt(3, (), (x - 9, y - 9, x + 9, y + 9))
    with Outlines(footage.shape, video.frame) as network:
        clicked, boxed = (
            clicked_mask(footage, static_scene(footage), 3, asked, None, network).soft > 0.5
            for asked in (click(3), box)
        )
    assert overlap(clicked, discs[3]) > 0.8
    assert (boxed & discs[3]).sum() > 0.8 * discs[3].sum()


def test_what_outlines_lead_to_from_a_click_is_seen_whatever_colours_it_has(tmp_path) -> None:
    """A box before a shirt of its colour: by colours alone it may be the shirt."""
    frames, people, _ = plain()
    boxes = [np.zeros((H, W), bool) for _ in frames]
    for i, (frame, person, box) in enumerate(zip(frames, people, boxes, strict=True)):
        box[40:52, 44 + i // 3 : 58 + i // 3] = True
        frame[:] = (120, 130, 90)
        frame[person | box] = (70, 80, 150)
        frame[box] = (150, 20, 20)  # and the rest of the person has as much of it
        frame[person & ~box & (np.arange(H)[:, None] > 54)] = (150, 20, 20)
        person |= box
    video = request(tmp_path, (frames, people, boxes))
    footage = read_footage(video, people)
    track = Track(np.stack(boxes).astype(np.uint8) * 255, np.ones(len(footage)))
    doubted = states_of(footage, {"object": track})["object"]
    assert doubted.count(DOUBTFUL) > len(footage) / 2
    led = {"object": np.arange(len(footage)) < 9}
    states = states_of(footage, {"object": track}, led)["object"]
    assert set(states[:9]) == {SEEN} and states[9:] == doubted[9:]


def test_the_tracker_uses_it_where_it_is_installed(fake, tmp_path) -> None:
    scene = plain()
    with_network = overlaps(masks_of(request(tmp_path / "a", scene, (click(3),))), scene[2])
    assert np.median(with_network) > 0.85


@pytest.mark.skipif(not Outlines.installed(), reason="needs `hoigs estimators install mediapipe`")
def test_the_network_itself_outlines_a_disc() -> None:
    frames, _, discs = plain()
    x, y = click(2).points[0].x, click(2).points[0].y
    with Outlines((H, W), lambda i: frames[i]) as network:
        network.look(2)
        by_point = network.found([(x, y)], [INSIDE])
        by_box = network.found([(x - 9, y - 9), (x + 9, y + 9)], [LOW, HIGH])[0]
    assert max(overlap(one.mask, discs[2]) for one in by_point) > 0.85
    assert overlap(by_box.mask, discs[2]) > 0.85 and by_box.quality > 0.7


def test_what_was_found_without_it_is_found_anew_with_it(monkeypatch) -> None:
    names = []
    for installed in (False, True):
        monkeypatch.setattr(Outlines, "installed", staticmethod(lambda there=installed: there))
        names.append(identity(ObjectTrackerEstimator()))
    assert names[0] != names[1] and names[1] == identity(ObjectTrackerEstimator())


def test_a_network_that_is_wanted_and_absent_is_named(tmp_path) -> None:
    with pytest.raises(HoigsError, match="hoigs estimators install mediapipe"):
        ObjectTrackerEstimator(network=True).estimate(request(tmp_path, plain(), (click(3),)))


def test_a_network_that_ends_says_what_it_said(fake) -> None:
    with Outlines((H, W), lambda i: np.zeros((H, W, 3), np.uint8)) as network:
        network.look(0, (0, 0, 20, 20))
        with pytest.raises(HoigsError, match=r"ended with code 1.*\n.*is not in the picture"):
            network.found([(90.0, 60.0)], [INSIDE])


def test_further_outputs_are_merged_into_a_model() -> None:
    """By the rules of Protocol Buffers alone: field 7 of the model, 12 of it, 1 of that."""
    name = "a" * 200
    added = with_outputs(b"", (name, "b"))
    assert added[0] == 7 << 3 | 2
    size, at = added[1] & 127 | added[2] << 7, 3
    assert size == len(added) - at and added[at] == 12 << 3 | 2
    assert added[at + 3] == 1 << 3 | 2 and added[at + 6 : at + 206] == name.encode()
    assert added[at + 206 :] == b"\x62\x03\x0a\x01b"
