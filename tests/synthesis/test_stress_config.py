"""Knobs that make a clip harder do what they say, and nothing at their defaults."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis import NoiseConfig, SceneConfig, generate
from hoigs.synthesis.degradation import mean_image, noisy_mask, noisy_poses, with_shutter
from hoigs.synthesis.object_motions import MOTIONS, Track
from hoigs.synthesis.textures import crate_faces, faded


def script(motion: str, frames: int = 48, **thing: object):
    config = SceneConfig.model_validate(
        {"frames": frames, "fps": 24, "object": {"motion": motion, **thing}}
    )
    return MOTIONS[motion](config).script()


def path_length(track: Track) -> float:
    return float(np.linalg.norm(np.diff(track.translations, axis=0), axis=-1).sum())


def turned(track: Track) -> float:
    """Degrees over the clip."""
    steps = np.einsum("fji,fjk->fik", track.rotations[:-1], track.rotations[1:])
    cosine = (np.trace(steps, axis1=1, axis2=2) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).sum())


def test_more_cycles_go_the_same_way_more_often() -> None:
    once, thrice = script("figure-eight", 481), script("figure-eight", 481, cycles=3)
    assert path_length(thrice.track) == pytest.approx(3 * path_length(once.track), rel=0.01)
    np.testing.assert_allclose(
        thrice.track.translations[160], once.track.translations[0], atol=1e-9
    )


def test_a_throw_turns_as_often_as_it_is_told() -> None:
    still, twice = script("thrown", 241, throw_turns=0), script("thrown", 241, throw_turns=2)
    assert turned(still.track) < 5
    assert turned(twice.track) - turned(still.track) == pytest.approx(720, abs=15)
    np.testing.assert_array_equal(still.track.translations, twice.track.translations)


def test_the_back_is_turned_for_its_share() -> None:
    def away(share: float | None) -> float:
        heading = np.degrees(script("carried", 400, hidden_share=share).walk.heading)
        return float((heading > 140).mean())

    shares = [away(s) for s in (0.0, 0.15, 0.3, 0.5)]
    assert shares == sorted(shares)
    assert shares[0] < 0.3 and shares[3] > 0.5
    default = script("carried", 400)
    assert away(None) == pytest.approx(float((np.degrees(default.walk.heading) > 140).mean()))


def test_hands_let_go_as_often_as_they_are_told() -> None:
    for count in (0, 1, 3):
        grip = script("pushed", 400, regrips=count).grip
        inside = grip[60:340] < 0.5
        assert int((np.diff(inside.astype(int)) == 1).sum()) == count
        assert grip.min() >= 0 and grip.max() <= 1


def test_an_object_appears_in_its_frame(body: AnnyBody) -> None:
    config = SceneConfig.tiny(frames=9, width=32, height=32, held_out_views=0,
                            object={"motion": "figure-eight", "appears": 0.5})  # fmt: skip
    scene = generate(config, body)
    seen = [scene.render(f, scene.cameras[f]).mask("object").any() for f in range(9)]
    assert seen == [False] * 4 + [True] * 5


def test_contrast_fades_to_the_mean_colour() -> None:
    side = crate_faces(np.random.default_rng(0), 32)[0]
    assert faded(side, 1.0) is side
    half, plain = faded(side, 0.5), faded(side, 0.0)
    np.testing.assert_allclose(half.std(), 0.5 * side.std(), rtol=0.2)
    np.testing.assert_allclose(plain, np.broadcast_to(side.mean((0, 1)), side.shape))


def test_a_long_shutter_is_the_mean_of_its_frames(body: AnnyBody) -> None:
    config = SceneConfig.tiny(frames=5, width=32, height=32, held_out_views=1)
    views = list(generate(config, body).views())
    assert [v for v, _ in with_shutter(iter(views), 1)] == [v for v, _ in views]
    blurred = list(with_shutter(iter(views), 3))
    wanted = mean_image([v.image for v, _ in views[1:4]])
    np.testing.assert_array_equal(blurred[2][0].image, wanted)
    assert (blurred[2][0].image != views[2][0].image).any()
    np.testing.assert_array_equal(blurred[2][0].entity, views[2][0].entity)
    assert [h for _, h in blurred] == [h for _, h in views], "held-out views stay exact"
    black, white = np.zeros((1, 1, 3), np.uint8), np.full((1, 1, 3), 255, np.uint8)
    assert mean_image([black, white])[0, 0, 0] == 188  # half the light, in sRGB
    with pytest.raises(ValueError, match="odd"):
        SceneConfig.model_validate({"camera": {"shutter_frames": 4}})


def test_edges_of_masks_move_by_pixels() -> None:
    disc = np.hypot(*(np.mgrid[0:60, 0:60] - 30)) < 18
    rng = np.random.default_rng(0)
    areas = {int(noisy_mask(disc, NoiseConfig(mask_edge_pixels=3), rng).sum()) for _ in range(60)}
    assert len(areas) == 7 and disc.sum() in areas


def test_a_wrong_shape_is_wrong_in_all_frames_alike() -> None:
    poses = BodyPose.zeros(6, betas=10)
    noisy = noisy_poses(poses, NoiseConfig(betas=0.2), np.random.default_rng(0))
    assert noisy.betas.shape == (10,) and 0.05 < float(noisy.betas.std()) < 0.5
    assert torch.equal(noisy.body, poses.body)
