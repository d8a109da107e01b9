"""Small things are followed in a part of the picture at the video's own size; what moves as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from disc_world import request, texture
from scipy import ndimage
from test_behind import footage_of

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    Estimates,
    FramePrompt,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.closer import closer, part_about
from hoigs.plugins.estimators.object_tracker.footage import read_footage
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, fine, prompted_mask
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import static_scene
from hoigs.plugins.estimators.object_tracker.states import DOUBTFUL, SEEN, states_of
from hoigs.plugins.estimators.object_tracker.together import together
from hoigs.plugins.estimators.object_tracker.tracker import Said, read_tracks, write_tracks

H, W, COUNT = 120, 200, 5


def cup_in_a_hand(tmp_path: Path) -> tuple[VideoRequest, list[np.ndarray]]:
    """A white thing of 8 pixels before a person of 50, at the right of a larger picture."""
    y, x = np.mgrid[:H, :W] + 0.5
    wall = texture(0, (90, 110, 80), (H, W))
    frames, people, cups = [], [], []
    for i in range(COUNT):
        image, person = wall.copy(), (np.abs(x - 150) < 12) & (np.abs(y - 60) < 25)
        image[person] = (150, 105, 85)
        cups.append((np.abs(x - 146 - 2 * i) < 4) & (np.abs(y - 60) < 4))
        image[cups[-1]] = (240, 240, 235)
        frames.append(ndimage.gaussian_filter(image, (0.5, 0.5, 0)).astype(np.uint8))
        people.append(person)
    video = request(tmp_path, (frames, people, cups), (FramePrompt(2, (PromptPoint(150, 60),)),))
    known = Estimates(EntityMasks({"human": people}))
    return VideoRequest(
        COUNT, W, H, lambda i: frames[i], tmp_path, tmp_path, entities=video.entities, known=known
    ), cups


def test_a_small_thing_is_looked_at_more_closely(tmp_path: Path) -> None:
    video, cups = cup_in_a_hand(tmp_path)
    people = video.known.masks.entities["human"]  # type: ignore[union-attr]
    footage = read_footage(video, people, (), 100)
    soft = np.zeros(footage.shape, np.float32)
    soft[29:31, 74:76] = 1
    mask = PromptedMask(2, soft, 0.5, True, footage.blank[2], fine=fine(soft > 0.5))
    part = part_about(footage, [mask], 200)
    assert part is not None
    near = closer(video, part)
    assert near.width == part[2] - part[0] < 120 and near.frame(0).shape[:2] == (
        near.height,
        near.width,
    )
    footage = read_footage(near, near.known.masks.entities["human"], (), 200)  # type: ignore[union-attr]
    assert footage.scale == 1
    (prompt,) = near.entities[0].prompts
    found = prompted_mask(footage, static_scene(footage), 2, prompt).soft > 0.5
    true = cups[2][part[1] : part[3], part[0] : part[2]]
    assert (found & true).sum() > 0.7 * (found | true).sum()
    # and the masks are given at the video's size
    soft = np.uint8(255) * np.stack([cup[part[1] : part[3], part[0] : part[2]] for cup in cups])
    file = tmp_path / "tracks.npz"
    said = Said({}, [], {"object": [SEEN] * COUNT}, part)
    write_tracks(file, near, footage, {"object": Track(soft, np.ones(COUNT))}, said)
    masks = read_tracks(file, video, ["object"]).entities["object"]
    assert all((masks[i] == cups[i]).all() for i in range(COUNT))


def test_what_moves_as_one_is_told_from_what_is_behind_it() -> None:
    """A half of a box foretells the other half, and no wall."""
    wall, box = texture(0, (120, 130, 90), (90, 140)), texture(1, (125, 120, 100), (30, 40))
    frames = []
    for i in range(9):
        image = wall.copy()
        image[30:60, 20 + 4 * i : 60 + 4 * i] = box
        frames.append(image.astype(np.uint8))
    nobody = [np.zeros((90, 140), bool)] * 9
    footage = footage_of(frames, nobody)
    scene, half = static_scene(footage), np.zeros((90, 140), np.float32)
    half[30:60, 36:56] = 1
    moves = together(footage, scene, 4, half)
    assert moves is not None
    odds = moves.odds((90, 140))
    assert odds[35:55, 58:72].mean() > 0.4 and odds[35:55, 80:].mean() < 0.1
    whole = np.zeros((90, 140), bool)
    whole[30:60, 36:76] = True
    assert moves.agreement(whole) > moves.agreement(half > 0.5) + 0.1
    still = footage_of([frames[4]] * 9, nobody)
    assert together(still, static_scene(still), 4, half) is None


def test_a_hand_that_is_followed_is_doubtful() -> None:
    y, x = np.mgrid[:60, :80] + 0.5
    person = (np.abs(x - 40) < 15) & (y > 10)
    image = np.full((60, 80, 3), 90, np.uint8)
    image[person] = (190, 140, 115)
    hand, cup = (np.hypot(x - 40, y - 40) < r for r in (5, 3))
    shown = image.copy()
    shown[cup] = (240, 240, 240)
    soft = np.uint8(255) * np.stack([hand, cup])
    states = states_of(footage_of([image, shown], [person] * 2), {"o": Track(soft, np.ones(2))})
    assert states["o"] == [DOUBTFUL, SEEN]
