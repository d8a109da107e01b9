"""Equal objects: the places of a frame, joint paths through them, and discs that cross."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from disc_world import COUNT, RADIUS, H, W, masks_of, request, texture
from test_behind import footage_of

from hoigs.core.interfaces.estimator import EntityRequest, FramePrompt, PromptPoint
from hoigs.plugins.estimators.object_tracker.appearance import Appearance, twins_of
from hoigs.plugins.estimators.object_tracker.places import Shape, places_of
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask
from hoigs.plugins.estimators.object_tracker.scene import static_scene
from hoigs.plugins.estimators.object_tracker.together import (
    CLEAR,
    LONG,
    Hypothesis,
    View,
    cheapest,
    groups_of,
    lasting,
    rivals_of,
)

Y, X = np.mgrid[:H, :W] + 0.5
NOBODY = np.zeros((H, W), bool)


def disc(x: float, y: float) -> np.ndarray:
    return np.hypot(X - x, Y - y) < RADIUS


def odds_of(*discs: np.ndarray) -> np.ndarray:
    return np.where(np.any(discs, axis=0), 4.0, -4.0)


@pytest.mark.parametrize("apart", [(40.0, 0.0), (11.0, 0.0), (6.0, 7.0)])
def test_two_objects_of_which_one_is_partly_behind_the_other_have_two_places(apart) -> None:
    centers = np.array([(40.0, 36.0), np.add((40.0, 36.0), apart)])
    odds = odds_of(*(disc(*c) for c in centers))
    found = np.array([p.middle for p in places_of(odds, NOBODY, Shape.of(disc(30, 30)), [], 4)])
    assert len(found) == 2
    away = np.hypot(*(found[:, None] - centers).transpose(2, 0, 1))
    assert (away.min(0) < 2).all() and (away.min(1) < 2).all()


def test_a_known_place_stays_first_and_one_object_has_one_place() -> None:
    odds, shape = odds_of(disc(30, 36), disc(80, 36)), Shape.of(disc(30, 30))
    found = places_of(odds, NOBODY, shape, [np.array((80.0, 36.0))], 4)
    assert [round(p.middle[0] / 10) for p in found] == [8, 3]
    assert len(places_of(odds_of(disc(2, 36)), NOBODY, shape, [], 4)) == 1  # partly out of it
    assert places_of(odds_of(NOBODY), NOBODY, shape, [], 4) == []


def tracked_through(
    frames: list[list[tuple[float, float]]],
    hidden: bool = False,
    given: dict[int, dict[int, int]] | None = None,
) -> Hypothesis:
    """The cheapest hypothesis of two objects of breadth 10 from the places of a first frame."""
    views = [
        View(
            i, np.array(places, float).reshape(-1, 2), np.full(len(places), 0.8),
            np.zeros(len(places), bool), (given or {}).get(i, {}), lambda to: hidden,
        )
        for i, places in enumerate(frames)
    ]  # fmt: skip
    start = Hypothesis.starting(10.0, views[0].places, 0, len(frames))
    return cheapest(start, views[1:])


def test_objects_that_cross_go_on_as_they_went_whatever_the_order_of_the_places() -> None:
    a = [(6.0 * i, 20 + 0.5 * i) for i in range(11)]
    b = [(60 - 6.0 * i, 26 - 0.5 * i) for i in range(11)]
    found = tracked_through(
        [[p, q][:: -1 if i % 2 and i else 1] for i, (p, q) in enumerate(zip(a, b))]
    )
    assert np.allclose(found.trail, [a, b])
    assert (found.margin > CLEAR).all()


def test_after_both_were_hidden_in_one_place_it_is_not_sure_which_is_which() -> None:
    """They meet behind something, and come out of it again one after the other."""
    met = [[(20.0, 20), (40.0, 20)], [(24.0, 20), (36.0, 20)], [], [], [], [], [], []]
    apart = [[(26.0, 20), (34.0, 20)], [(22.0, 20), (38.0, 20)], [(18.0, 20), (42.0, 20)]]
    found = tracked_through(met + apart, hidden=True)
    assert np.isfinite(found.trail[:, -1]).all()
    assert (found.margin[:, -3:] < CLEAR).all() and (found.margin[:, 1] > CLEAR).all()
    for clicked in (0, 1):  # in the last frame, which says it of those before as well
        found = tracked_through(met + apart, hidden=True, given={10: {0: clicked}})
        assert np.allclose(found.trail[0, -1], apart[-1][clicked])
        assert (found.margin[:, -3:] > CLEAR).all()


def test_an_object_that_another_passes_is_where_it_was() -> None:
    """One rests, hidden for two frames by the one that passes before it."""
    passing = [(10.0 + 8 * i, 22.0) for i in range(8)]
    frames = [[p, (42.0, 20.0)] if i not in (3, 4) else [p] for i, p in enumerate(passing)]
    found = tracked_through(frames)
    assert np.allclose(found.trail[0], passing)
    assert np.isnan(found.trail[1, 3:5]).all() and np.allclose(found.trail[1, 5:], (42, 20))


@pytest.mark.parametrize("rests", [False, True])
def test_what_comes_to_a_place_that_looks_as_before_was_there_and_is_another(rests: bool) -> None:
    start = Hypothesis.starting(10.0, np.array([(10.0, 20.0)]), 0, 2)
    there, new = np.array([(16.0, 20.0)]), np.full(1, 0.8)
    found = cheapest(start, [View(1, there, new, np.array([rests]), {}, lambda to: True)])
    assert np.isnan(found.trail[0, 1]).all() == rests


def test_groups_are_of_what_was_clicked_in_one_frame_and_looks_alike() -> None:
    def prompted(mask: np.ndarray, frame: int) -> PromptedMask:
        return PromptedMask(frame, mask.astype(np.float32), 1.0, False, NOBODY)

    a, b, c = disc(20, 20), disc(60, 20), disc(90, 60)
    prompts = {"a": [prompted(a, 0)], "b": [prompted(b, 0)], "c": [prompted(c, 0)]}
    twins: dict[str, dict[int, np.ndarray]] = {"a": {0: b}, "b": {}, "c": {}}
    assert groups_of(prompts, twins) == [(0, ["a", "b"])]
    twins |= {"b": {0: a}, "c": {0: a | b}}
    assert groups_of(prompts, twins) == [(0, ["a", "b", "c"])]


def test_two_equal_discs_that_cross_keep_their_names(tmp_path: Path) -> None:
    wall, ball = texture(0, (120, 130, 90)), np.uint8(texture(1, (200, 60, 50)))[:40, :40]
    truth = {"low": [], "high": []}
    frames = []
    for i in range(COUNT):
        image = np.uint8(wall[:, :W])
        for name, (cx, cy) in (("high", (92 - 6 * i, 32)), ("low", (14 + 6 * i, 42))):
            mask = disc(cx, cy)
            image[mask] = np.roll(ball, (cy % 40, cx % 40), (0, 1))[
                np.ix_(np.arange(H) % 40, np.arange(W) % 40)
            ][mask]
            truth[name].append(mask)
        frames.append(image)
    truth["high"] = [m & ~n for m, n in zip(truth["high"], truth["low"])]
    at = {"low": (14.0, 42.0), "high": (92.0, 32.0)}
    video = replace(
        request(tmp_path, (frames, [NOBODY] * COUNT, [])),
        entities=tuple(
            EntityRequest(n, "object", further=(FramePrompt(0, (PromptPoint(*p),)),))
            for n, p in at.items()
        ),
    )
    found = masks_of(video)
    for name, true in truth.items():
        masks = [found.entities[name][i] for i in range(COUNT)]
        share = np.array([(m & t).sum() / max((m | t).sum(), 1) for m, t in zip(masks, true)])
        assert not any(m.any() and (m & t).sum() < 0.5 * m.sum() for m, t in zip(masks, true))
        assert (share > 0.6).mean() > 0.8, share


@pytest.mark.parametrize("moves", [False, True])
def test_what_hangs_on_the_wall_is_no_rival_of_what_is_held(moves: bool) -> None:
    wall, ball = texture(0, (120, 130, 90)), np.uint8(texture(1, (200, 60, 50)))[:40, :40]
    frames, people, held = [], [], []
    for i in range(COUNT):
        image = np.uint8(wall[:, :W])
        mine = disc(30, 24 + 2 * i)
        for mask, y in ((mine, 24 + 2 * i), (disc(86, 34 + 2 * moves * i), 34 + 2 * moves * i)):
            rolled = np.roll(ball, (y % 40, 0), (0, 1))
            image[mask] = rolled[np.ix_(np.arange(H) % 40, np.arange(W) % 40)][mask]
        frames.append(image)
        held.append(mine)
        people.append(mine)
    footage = footage_of(frames, people)
    known = {0: held[0]}
    looks = Appearance.learnt(footage, known)
    assert twins_of(looks, known)
    assert bool(rivals_of(footage, static_scene(footage), looks, known)) == moves


def test_an_object_that_was_not_seen_for_long_may_be_anywhere() -> None:
    sure = np.ones(40, bool)
    sure[5 : 5 + LONG - 1] = False
    assert np.array_equal(lasting(sure), sure)
    sure[5 : 5 + LONG] = False
    assert np.array_equal(np.flatnonzero(lasting(sure)), np.arange(5))
