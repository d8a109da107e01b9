"""Long and thin things, followed as lines from the hand that holds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from disc_world import H, W, masks_of, request, texture
from test_behind import footage_of

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    FramePrompt,
    Landmarks,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.footage import body_colors, usual_torso
from hoigs.plugins.estimators.object_tracker.prompts import overlap
from hoigs.plugins.estimators.object_tracker.rod import (
    Rod,
    clicked_rod,
    rod_followed,
    rod_of,
    rods_held,
)
from hoigs.plugins.estimators.object_tracker.scene import static_scene

COUNT, CLICKED = 20, 4
HAND, LENGTH = np.array((72.0, 36.0)), 28.0
BLACK, SKY = (30, 30, 40), (90, 140, 220)


def swing(i: int) -> float:
    return 1.2 - 0.13 * i


def scene(angles, color=BLACK, breadth: float = 2.0, disc: bool = False):
    """Frames of a person whose hand holds rods, at `angles` in each frame; masks of the person and
    of the first rod. The wall changes its colour half way up."""
    wall = texture(0, (120, 130, 90))[:, :W]
    wall[:20] = texture(1, SKY)[:20, :W]
    rng, (y, x) = np.random.default_rng(3), np.mgrid[:H, :W] + 0.5
    arm = (np.abs(y - 36) < 2) & (x > 30) & (x < HAND[0])
    person = (np.abs(x - 30) < 6) | arm | (np.hypot(x - HAND[0], y - HAND[1]) < 3)
    frames, masks = [], []
    for i in range(COUNT):
        image, found = wall + rng.normal(size=wall.shape), []
        for angle in angles(i):
            along = np.array((np.cos(angle), np.sin(angle)))
            away = np.stack((x, y), -1) - HAND
            share, off = away @ along, away @ (-along[1], along[0])
            rod = (share > 0) & (share < LENGTH) & (np.abs(off) < breadth / 2)
            if disc:
                rod = np.hypot(*np.moveaxis(away - 14 * along, -1, 0)) < 9
            image[rod] = color
            found.append(rod & ~person)
        image[person] = (70, 80, 150)
        frames.append(image.clip(0, 255).astype(np.uint8))
        masks.append(found)
    return frames, [person] * COUNT, masks


def landmarks() -> np.ndarray:
    points = np.zeros((COUNT, 33, 4))
    points[..., 3] = 1
    for rows, at in (
        ((11,), (33, 22)), ((12,), (27, 22)), ((23,), (33, 44)), ((24,), (27, 44)),
        ((13,), (50, 36)), ((15, 17, 19), HAND), ((14, 16, 18, 20), (26, 40)),
    ):  # fmt: skip
        points[:, list(rows), :2] = at
    return points


def rod_in(frames, people, at: tuple[float, float], i: int = CLICKED):
    footage = footage_of(frames, people)
    behind = static_scene(footage)
    return footage, behind, rod_of(footage, behind, [landmarks()], i, np.array(at))


def middle(angle: float, share: float = 0.6) -> tuple[float, float]:
    x, y = HAND + share * LENGTH * np.array((np.cos(angle), np.sin(angle)))
    return float(x), float(y)


def followed(frames, people, angle: float) -> tuple[np.ndarray, Rod]:
    footage, behind, rod = rod_in(frames, people, middle(angle))
    assert rod is not None
    return rod_followed(footage, behind, [landmarks()], [rod]).soft > 127, rod


def test_a_swung_rod_is_followed_whatever_is_behind_it() -> None:
    frames, people, masks = scene(lambda i: [swing(i)])
    found, rod = followed(frames, people, swing(CLICKED))
    assert abs(rod.line.length - LENGTH) < 4 and rod.other is None
    overlaps = [overlap(mask, true[0]) for mask, true in zip(found, masks, strict=True)]
    assert np.mean(np.array(overlaps) > 0.5) > 0.9


def test_what_a_hand_holds_in_its_middle_is_followed_on_both_sides() -> None:
    frames, people, masks = scene(lambda i: [swing(i), swing(i) + np.pi])
    found, rod = followed(frames, people, swing(CLICKED))
    assert rod.other is not None
    shown = [(mask & true[1]).sum() > 0.5 * true[1].sum()
             for mask, true in zip(found, masks, strict=True) if true[1].sum() > 40]  # fmt: skip
    assert np.mean(shown) > 0.8


def test_of_two_lines_that_may_be_it_none_is_taken() -> None:
    frames, people, _ = scene(lambda i: [swing(i)] + ([swing(i) + 1.3] if i > 11 else []))
    found, _ = followed(frames, people, swing(CLICKED))
    assert found[: CLICKED + 3].any((1, 2)).all() and not found[12:].any()


def test_a_frame_without_it_has_no_mask() -> None:
    frames, people, _ = scene(lambda i: [swing(i)] if i < 12 else [])
    found, _ = followed(frames, people, swing(CLICKED))
    assert not found[12:].any()


def test_somebody_at_a_table_whose_hips_nobody_sees_holds_one_too() -> None:
    frames, people, _ = scene(lambda i: [swing(i)])
    footage, marks = footage_of(frames, people), landmarks()
    marks[:, [11, 12], 0] = 40, 24
    marks[:, [23, 24], 3] = 0
    assert usual_torso([marks]) == pytest.approx(1.4 * 16)
    rod = rod_of(footage, static_scene(footage), [marks], CLICKED, np.array(middle(swing(CLICKED))))
    assert rod is not None and abs(rod.line.length - LENGTH) < 4
    assert body_colors(footage, [marks]) is not None
    marks[:, [11, 12], 3] = 0
    assert np.isnan(usual_torso([marks])) and body_colors(footage, [marks]) is None


def test_a_disc_and_a_limb_are_no_rods() -> None:
    frames, people, _ = scene(lambda i: [swing(i)], disc=True)
    assert rod_in(frames, people, middle(swing(CLICKED), 0.5))[2] is None
    assert rod_in(frames, people, (60.0, 36.0))[2] is None
    assert rod_in(frames, people, (90.0, 10.0))[2] is None  # nothing is there


def right_in_most(video: VideoRequest, masks: list[list[np.ndarray]]) -> EntityMasks:
    """What the estimator finds where the hand is known."""
    assert video.known is not None
    known = replace(video.known, landmarks={"human": Landmarks(landmarks())})
    found = masks_of(replace(video, known=known))
    theirs = [found.entities["object"][i] for i in range(COUNT)]
    overlaps = [overlap(mask, true[0]) for mask, true in zip(theirs, masks, strict=True)]
    assert np.mean(np.array(overlaps) > 0.5) > 0.9
    return found


def test_a_click_on_a_rod_is_enough(tmp_path: Path) -> None:
    """Also one in front of something of its colours, on which no mask could grow."""
    frames, people, masks = scene(lambda i: [swing(i)])
    click = FramePrompt(CLICKED, (PromptPoint(*middle(swing(CLICKED))),))
    found = right_in_most(request(tmp_path, (frames, people, masks), (click,)), masks)
    assert found.states is not None and set(found.states["object"]) <= {"seen", "lost"}


def test_a_rod_that_nobody_clicked_is_found_in_the_hand(tmp_path: Path) -> None:
    frames, people, masks = scene(lambda i: [swing(i)])
    found = right_in_most(request(tmp_path, (frames, people, masks)), masks)
    (prompt,) = found.chosen["object"]
    x, y = prompt.points[0].x, prompt.points[0].y
    assert masks[prompt.frame][0][round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3].any()


def test_a_bare_hand_holds_no_rod() -> None:
    frames, people, _ = scene(lambda i: [])
    footage = footage_of(frames, people)
    assert rods_held(footage, static_scene(footage), [landmarks()], range(COUNT)) == []


def test_the_clicked_mask_is_that_of_its_frame() -> None:
    frames, people, masks = scene(lambda i: [swing(i)])
    footage, behind, rod = rod_in(frames, people, middle(swing(CLICKED)))
    assert rod is not None
    mask = clicked_rod(footage, behind, [landmarks()], rod)
    assert mask.frame == CLICKED and overlap(mask.soft > 0.5, masks[CLICKED][0]) > 0.5
