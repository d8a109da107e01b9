"""Poses and cameras of test frames: given, between the neighbours', or fitted to the image."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_quats, multiply_quats, quats_to_axis_angle
from hoigs.core.maths.splines import neighbours
from hoigs.core.model.compose import compose
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import POSES_ESTIMATED, Clip, FrameStore
from hoigs.core.values.moment import BodyPose
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.options import ScoreOptions
from hoigs.evaluation.posing import (
    camera_between,
    fit_frame,
    pose_between,
    posed_clip,
    source_of_poses,
)
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin_clip

TEST, TRAIN = 5, (4, 6)


class Drawn(FrameStore):
    """A model's own pictures of a clip."""

    def __init__(self, base: FrameStore, images: dict[int, Tensor]) -> None:
        self.base, self.images = base, images

    def image(self, position: int) -> Tensor:
        return self.images.get(position, self.base.image(position))

    def mask(self, entity: str, position: int) -> Tensor:
        return self.base.mask(entity, position)

    def depth(self, position: int) -> Tensor | None:
        return self.base.depth(position)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneModel, Clip]:
    """A composed human before a wall, and a clip whose test image it drew itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        clip = ClipFolderReader().read(builtin_clip(AnnyBody(), SceneConfig.tiny()))
    changes = ["entities=[scene, human]", "model.human.points=2500"]
    model = compose(Spec.load("hoigs", overrides=changes), clip).eval()
    colors = torch.rand(2500, 3, generator=torch.Generator().manual_seed(0))
    human = model.entity("human")
    human.sh.data[:, 0] = 1.5 * torch.sin(20 * human.means.detach() + colors)
    split = {"train": [p for p in range(len(clip)) if p != TEST], "test": [TEST]}
    with torch.no_grad():
        color = model.render(clip.moments[TEST], clip.cameras[TEST]).color
    image = (255 * color.clamp(0, 1)).round().to(torch.uint8)
    return model, replace(clip, store=Drawn(clip.store, {TEST: image}), split=split, held_out=None)


def with_pose(clip: Clip, change: Tensor, shift: float) -> Clip:
    """The test frame's pose made wrong."""
    moments = list(clip.moments)
    pose = moments[TEST].poses["human"]
    wrong = pose.with_residual(change).replace(transl=pose.transl + shift)
    moments[TEST] = moments[TEST].with_pose("human", wrong)
    return replace(clip, moments=moments)


def test_neighbours_hold_at_the_ends() -> None:
    times = [0.0, 0.25, 1.0]
    assert neighbours(-1.0, times) == (0, 0, 0.0)
    assert neighbours(0.25 + 1e-8, times) == (1, 1, 0.0)
    assert neighbours(2.0, times) == (2, 2, 0.0)
    low, high, r = neighbours(0.5, times)
    assert (low, high) == (1, 2) and r == pytest.approx(1 / 3)
    with pytest.raises(ValueError, match="`times` is empty"):
        neighbours(0.5, [])


def test_between_two_poses_joints_turn_at_a_steady_rate() -> None:
    zero = BodyPose.zeros()
    far = zero.replace(body=zero.body + torch.tensor([0.9, 0.0, 0.0]), transl=torch.ones(3))
    near = pose_between(zero, far, 0.25)
    torch.testing.assert_close(near.body, 0.25 * far.body)
    torch.testing.assert_close(near.transl, torch.full((3,), 0.25))


def test_between_two_poses_about_half_a_turn_the_form_of_the_first_is_kept() -> None:
    """3.1 rad about y and its neighbour at 3.3 rad: an axis-angle of -2.98 would be the same turn,
    but corrections learned beside the first would go backwards there."""
    y = torch.tensor([0.0, 1.0, 0.0])
    zero = BodyPose.zeros()
    a, b = zero.replace(global_orient=3.1 * y), zero.replace(global_orient=3.3 * y)
    torch.testing.assert_close(pose_between(a, b, 0.5).global_orient, 3.2 * y, atol=1e-5, rtol=0)
    torch.testing.assert_close(pose_between(b, a, 0.5).global_orient, 3.2 * y, atol=1e-5, rtol=0)


def test_between_two_cameras() -> None:
    def at(angle: float) -> Camera:
        eye = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
        return Camera.look_at(eye, torch.zeros(3), width=8, height=8, fov_y=0.7)

    middle = camera_between(at(-0.2), at(0.2), 0.5)
    rotation = middle.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(middle.center, 0.5 * (at(-0.2).center + at(0.2).center))
    torch.testing.assert_close(rotation, at(0.0).world_to_camera[:3, :3], atol=1e-5, rtol=0)


def test_interpolated_takes_nothing_from_the_test_frame(scene: tuple[SceneModel, Clip]) -> None:
    model, clip = scene
    spoiled = with_pose(clip, torch.ones(51, 3), 1.0)
    cameras = list(spoiled.cameras)
    cameras[TEST] = cameras[TEST].moved(torch.ones(3), torch.ones(3))
    spoiled = replace(spoiled, cameras=cameras)
    wanted = {"test_pose": "interpolated", "test_camera": "interpolated"}
    ours, theirs = (posed_clip(model, c, ScoreOptions(**wanted)) for c in (spoiled, clip))  # type: ignore[arg-type]
    for name, value in vars(ours.moments[TEST].poses["human"]).items():
        expected = getattr(theirs.moments[TEST].poses["human"], name)
        assert value == expected if isinstance(value, str) else torch.equal(value, expected)
    viewmats = [c.cameras[TEST].world_to_camera for c in (ours, theirs)]
    assert torch.equal(*viewmats)
    for p in clip.split["train"]:
        assert ours.moments[p] is spoiled.moments[p] and ours.cameras[p] is spoiled.cameras[p]
    low, high = (clip.moments[p].poses["human"].transl for p in TRAIN)
    torch.testing.assert_close(ours.moments[TEST].poses["human"].transl, 0.5 * (low + high))
    assert posed_clip(model, clip, ScoreOptions()) is clip
    with pytest.raises(ValueError, match="training frames"):
        posed_clip(
            model, replace(clip, split={"test": [TEST]}), ScoreOptions(test_pose="interpolated")
        )


def turned(a: BodyPose, b: BodyPose) -> Tensor:
    """Degrees between two poses, by joint."""
    inverse = axis_angle_to_quats(-a.rotations)
    apart = quats_to_axis_angle(multiply_quats(inverse, axis_angle_to_quats(b.rotations)))
    return torch.rad2deg(apart.norm(dim=-1))


def test_estimated_poses_of_test_frames_are_blended(scene: tuple[SceneModel, Clip]) -> None:
    model, clip = scene
    estimated = replace(clip, provenance={POSES_ESTIMATED: True})
    for source, pose in ((clip, "given"), (estimated, "blended")):
        (view,) = score(model, source, timing_frames=0).views
        assert view.protocol.test_pose == pose
    assert source_of_poses(estimated, "given") == "given"


def test_fitted_finds_the_pose_that_drew_the_image(scene: tuple[SceneModel, Clip]) -> None:
    model, clip = scene
    change = torch.zeros(51, 3)
    change[[15, 16]] = torch.tensor([0.0, 0.15, 0.2])  # shoulders, in joints 1..
    wrong = with_pose(clip, change, 0.03)
    trained = [p for p in model.parameters() if p.requires_grad]
    before = [p.detach().clone() for p in trained]
    fit = fit_frame(model, wrong[TEST], True, False, steps=40)
    assert fit.loss[1] < 0.5 * fit.loss[0]
    truth, found = clip.moments[TEST].poses["human"], fit.moment.poses["human"]
    start = wrong.moments[TEST].poses["human"]
    across = slice(0, 2)  # along the view one picture says little
    error = (found.transl - truth.transl)[across].norm()
    assert error < 0.5 * (start.transl - truth.transl)[across].norm()
    # a turn of an arm about itself shows in no picture of it: not all of the error can go
    assert turned(truth, found)[[16, 17]].mean() < 0.9 * turned(truth, start)[[16, 17]].mean()
    assert fit.camera is not wrong.cameras[TEST] and torch.equal(
        fit.camera.world_to_camera, wrong.cameras[TEST].world_to_camera
    )
    assert all(p.requires_grad and p.grad is None for p in trained), "the model is frozen"
    assert all(torch.equal(p, q) for p, q in zip(trained, before, strict=True))


def test_fitted_cameras(scene: tuple[SceneModel, Clip]) -> None:
    model, clip = scene
    cameras = list(clip.cameras)
    cameras[TEST] = cameras[TEST].moved(torch.tensor([0.01, -0.01, 0.005]), torch.full((3,), 0.01))
    wrong = replace(clip, cameras=cameras)
    fitted = posed_clip(model, wrong, ScoreOptions(test_camera="fitted", fit_steps=40))
    exact, given, found = (c.cameras[TEST].world_to_camera for c in (clip, wrong, fitted))
    assert (found[:3, :3] - exact[:3, :3]).norm() < 0.5 * (given[:3, :3] - exact[:3, :3]).norm()
    assert fitted.moments[TEST].poses["human"] is not None


def test_every_score_says_what_it_has_seen(scene: tuple[SceneModel, Clip]) -> None:
    model, clip = scene
    wrong = with_pose(clip, torch.zeros(51, 3), 0.05)
    scores, notes = {}, {}
    for pose in ("given", "interpolated", "fitted"):
        evaluation = score(model, wrong, test_pose=pose, fit_steps=25, timing_frames=0)  # type: ignore[arg-type]
        protocol = evaluation.views[0].protocol
        assert (protocol.test_pose, protocol.test_camera) == (pose, "given")
        assert protocol.fit_steps == (25 if pose == "fitted" else 0)
        record = evaluation.to_dict()["scores"][0]["protocol"]
        assert record["test_pose"] == pose and record["fit_steps"] == protocol.fit_steps
        scores[pose], notes[pose] = evaluation.score("human", "psnr"), protocol.footnotes()
        assert evaluation.scored is not None
    assert scores["fitted"] > scores["given"] + 3, scores
    loud = [line for line in notes["fitted"] if line.startswith("FITTED TO TEST IMAGES")]
    assert len(loud) == 1 and "very images that are scored" in loud[0]
    assert not any("FITTED" in line for line in (*notes["given"], *notes["interpolated"]))
    assert any("body poses: interpolated" in line for line in notes["interpolated"])
