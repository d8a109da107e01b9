"""The walk of builtin:carry: feet, place, and who hides whom."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis import SyntheticScene, generate
from hoigs.synthesis.named import clip_config
from hoigs.synthesis.object_motions import MOTIONS
from hoigs.synthesis.walking import STANCE, standing, walking

KEYS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.5, 90, 0.5], [0.9, 30, 1], [1.0, 30, 1]])
SMALL = "frames=24&width=64&samples=1&edge_samples=1&held_out_views=0"


@pytest.fixture(scope="module")
def carry(body: AnnyBody) -> SyntheticScene:
    return generate(clip_config(f"builtin:carry?{SMALL}"), body)


def test_who_stands_stays_where_feet_are_apart() -> None:
    walk = standing(5)
    assert not walk.place.any() and not walk.heading.any() and not walk.reach().any()
    assert walk.spots[0][0, 0] == STANCE and walk.spots[1][0, 0] == -STANCE
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_array_equal(walk.to_world(points), points)


def test_a_walk_has_the_length_and_the_middle_that_are_asked_for() -> None:
    walk = walking(400, KEYS, 2.0, (0.3, -0.2))
    steps = np.linalg.norm(np.diff(walk.place, axis=0), axis=-1)
    assert steps.sum() == pytest.approx(2.0, rel=5e-3)
    middle = (walk.place.max(0) + walk.place.min(0)) / 2
    np.testing.assert_allclose(middle, [0.3, 0, -0.2], atol=1e-3)
    moving = steps > 1e-3
    ahead = walk.rotations[1:, :, 2][moving]
    forward = (np.diff(walk.place, axis=0)[moving] * ahead).sum(-1)
    assert (forward > 0.99 * steps[moving]).all(), "one walks the way one faces"


def test_a_foot_on_the_floor_does_not_slide_and_one_always_is() -> None:
    walk = walking(600, KEYS, 2.0, (0, 0))
    down = []
    for spots in walk.spots:
        world = walk.to_world(spots)
        assert world[:, 1].min() > -1e-9 and 0.05 < world[:, 1].max() < 0.1
        low = world[:, 1] < 1e-9
        both = low[1:] & low[:-1]
        slid = np.linalg.norm(np.diff(world, axis=0), axis=-1)[both]
        assert slid.max() < 1e-6
        assert 0.4 < low.mean() < 0.9
        down.append(low)
    assert (down[0] | down[1]).all()
    assert walk.reach().max() < 0.45, "feet stay under the body"


def test_a_walk_does_not_depend_on_the_number_of_frames() -> None:
    few, many = (walking(n, KEYS, 2.0, (0, 0)) for n in (22, 64))
    np.testing.assert_allclose(few.place, many.place[::3], atol=1e-6)
    np.testing.assert_allclose(few.spots[0], many.spots[0][::3], atol=1e-6)


def test_walking_soles_touch_the_floor(body: AnnyBody, carry: SyntheticScene) -> None:
    soles = body(carry.poses).vertices[..., 1].min(-1).values
    assert soles.abs().max() < 0.015


def test_the_carried_box_stays_clear_of_the_body(body: AnnyBody, carry: SyntheticScene) -> None:
    track = carry.script.track
    vertices = body(carry.poses).vertices.numpy()
    local = np.einsum("fvi,fij->fvj", vertices - track.translations[:, None], track.rotations)
    inside = (np.array(carry.config.object.size) / 2 - np.abs(local)).min(-1)
    arms = np.isin(body.vertex_parts.numpy(), (6, 7, 8, 9))
    assert inside[:, ~arms].max() < -0.01 and inside[:, arms].max() < 0.01


def test_the_box_crosses_the_view_hides_the_body_and_is_hidden_by_it(carry: SyntheticScene) -> None:
    first, hidden, last = (carry.render(f, carry.cameras[f]) for f in (0, 12, 23))
    seen = {v.frame: int(v.mask("object").sum()) for v in (first, hidden, last)}
    assert seen[12] < 0.1 * seen[0] and seen[12] < 0.1 * seen[23], seen
    columns = [np.argwhere(v.mask("object"))[:, 1].mean() for v in (first, last)]
    assert columns[1] - columns[0] > 0.4 * carry.config.width
    # at the start the box stands before the person: body above, below and on both sides of it
    rows, cols = np.nonzero(first.mask("object"))
    body_rows, body_cols = np.nonzero(first.mask("human"))
    assert body_rows.min() < rows.min() and body_rows.max() > rows.max()
    assert body_cols.min() < cols.mean() < body_cols.max()


def test_no_other_motion_walks() -> None:
    for motion in MOTIONS:
        config = clip_config(f"builtin:lift-and-swing?object.motion={motion}")
        moved = np.ptp(MOTIONS[motion](config).script().walk.place, axis=0).max()
        assert (moved > 1) == (motion == "carried")
