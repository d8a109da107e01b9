from __future__ import annotations

import numpy as np
import pytest

from hoigs.synthesis import SceneConfig
from hoigs.synthesis.object_motions import GRAVITY, MOTIONS


def _config(motion: str, **more: object) -> SceneConfig:
    return SceneConfig.model_validate({"object": {"motion": motion, **more}})


@pytest.mark.parametrize("motion", MOTIONS)
def test_tracks_are_rotations_of_every_frame(motion: str) -> None:
    track = MOTIONS[motion](_config(motion)).script().track
    assert track.rotations.shape == (64, 3, 3) and track.translations.shape == (64, 3)
    unit = track.rotations @ track.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-9)
    assert (np.linalg.det(track.rotations) > 0).all()


def test_a_held_box_is_lifted_swung_and_put_down_on_its_stools() -> None:
    config = _config("held")
    script = MOTIONS["held"](config).script()
    place, low = script.track.translations, config.object.stand_height + config.object.size[1] / 2
    for frame, stand in ((0, script.stands[0]), (-1, script.stands[1])):
        np.testing.assert_allclose(place[frame], [stand.x, low, stand.z], atol=1e-6)
        upright = script.track.rotations[frame]
        assert upright[1, 1] == pytest.approx(1)
    assert place[:, 1].max() > low + 0.4
    assert place[:, 1].min() > low - 1e-6
    # it goes over to the left, comes back to the right, and ends on the left
    across = np.sign(place[np.abs(place[:, 0]) > 0.05, 0])
    assert (np.diff(across) != 0).sum() == 3
    assert script.grip[0] == 0 and script.grip[-1] == 0 and script.grip[30] == 1
    moved = np.linalg.norm(np.diff(place, axis=0), axis=-1) > 1e-3
    assert (script.grip[1:][moved] > 0.95).all()


def test_the_path_does_not_depend_on_the_number_of_frames() -> None:
    few = MOTIONS["held"](_config("held").model_copy(update={"frames": 22})).script()
    many = MOTIONS["held"](_config("held").model_copy(update={"frames": 64})).script()
    np.testing.assert_allclose(few.track.translations, many.track.translations[::3], atol=1e-3)


def test_a_throw_is_free_fall() -> None:
    config = SceneConfig.model_validate({"frames": 256, "fps": 64, "object": {"motion": "thrown"}})
    script = MOTIONS["thrown"](config).script()
    height = script.track.translations[:, 1]
    flying = np.flatnonzero(height - script.hold.translations[:, 1] > 0.02)
    inner = height[flying[0] + 4 : flying[-1] - 4]
    fall = np.diff(inner, 2) * config.fps**2
    np.testing.assert_allclose(fall, -GRAVITY, rtol=0.02)
    assert height.max() - script.hold.translations[:, 1].max() == pytest.approx(
        config.object.throw_height, abs=0.01
    )
    assert script.grip[flying].min() < 0.3  # the hands let go


def test_a_pushed_box_stays_on_the_table() -> None:
    track = MOTIONS["pushed"](_config("pushed")).script().track
    assert np.ptp(track.translations[:, 1]) < 1e-9
    assert np.ptp(track.translations[:, 0]) > 0.4


def test_only_a_bending_bar_bends_and_only_a_soft_ball_is_squeezed() -> None:
    for motion in MOTIONS:
        script = MOTIONS[motion](_config(motion)).script()
        assert (np.abs(script.bend).max() > np.radians(50)) == (motion == "bending")
        assert (script.squeeze.min() < 0.8) == (motion == "squeezed")
        assert script.squeeze.max() == pytest.approx(1)


def test_an_object_that_moves_alone_is_not_held() -> None:
    config = SceneConfig.model_validate({"object": {"motion": "gliding", "alone": True}})
    script = MOTIONS["gliding"](config).script()
    assert script.grip.max() == 0 and np.ptp(script.hold.translations, axis=0).max() == 0
    assert np.ptp(script.track.translations[:, 0]) > 0.4


def test_a_static_object_never_moves() -> None:
    script = MOTIONS["static"](_config("static")).script()
    assert np.ptp(script.track.translations, axis=0).max() == 0
    assert np.ptp(script.track.rotations, axis=0).max() == 0
    assert script.grip.max() == 0


def test_a_glide_is_uniform() -> None:
    track = MOTIONS["gliding"](_config("gliding")).script().track
    steps = np.diff(track.translations, axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)
    turns = track.rotations[:-1].transpose(0, 2, 1) @ track.rotations[1:]
    np.testing.assert_allclose(turns, np.broadcast_to(turns[0], turns.shape), atol=1e-12)
    assert np.linalg.norm(steps.sum(0)) > 0.4


def test_a_figure_eight_crosses_itself_in_the_middle() -> None:
    config = SceneConfig.model_validate({"frames": 65, "object": {"motion": "figure-eight"}})
    place = MOTIONS["figure-eight"](config).script().track.translations
    np.testing.assert_allclose(place[0], place[32], atol=1e-9)
    np.testing.assert_allclose(place[0], place[64], atol=1e-9)
    assert np.ptp(place[:, 0]) > 0.4 and np.ptp(place[:, 1]) > 0.25
    height = place[:, 1] - place[0, 1]
    assert (np.diff(np.sign(height[np.abs(height) > 1e-6])) != 0).sum() == 3


def test_jolts_shake_a_pushed_box_and_the_hands_with_it() -> None:
    calm = MOTIONS["pushed"](_config("pushed")).script()
    shaken = MOTIONS["pushed"](_config("pushed", jolt_metres=0.03)).script()
    jolts = shaken.track.translations - calm.track.translations
    np.testing.assert_array_equal(jolts[:, 1:], 0)
    assert 0.02 < jolts[calm.grip > 0.9, 0].std() < 0.04
    assert jolts[0, 0] == 0 and jolts[-1, 0] == 0  # nobody holds it
    np.testing.assert_array_equal(shaken.hold.translations, shaken.track.translations)
