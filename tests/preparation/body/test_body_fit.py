"""The body fit, against bodies whose pose is known: landmarks are the body's own points."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    axis_angle_to_quats,
    multiply_quats,
    quats_to_axis_angle,
)
from hoigs.core.maths.skinning import skin, transform_points
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import (
    FitOptions,
    FitProblem,
    Observations,
    Unknowns,
    ground_scale,
)
from hoigs.preparation.body.fitted import BodyFit
from hoigs.preparation.body.kinematics import NormalEquations
from hoigs.preparation.body.landmarks import FrameFates, Landmarks, points_of
from hoigs.preparation.body.priors import beyond
from hoigs.preparation.body.start import limb_pose
from hoigs.preparation.people import fates_said, stature
from hoigs.preparation.report.overlay import overlay_frame

FRAMES, WIDTH, HEIGHT, FOCAL = 9, 640, 480, 600.0
QUICK = FitOptions(steps=25)


@cache
def body() -> AnnyBody:
    return AnnyBody()


def camera(center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    w2c = torch.eye(4)
    w2c[:3, 3] = -torch.tensor(center)
    return Camera(K, w2c, WIDTH, HEIGHT)


def truth() -> BodyPose:
    """Facing the camera (y down), arms hanging and bending, a knee that lifts, walking aside."""
    t = torch.linspace(0, 1, FRAMES)
    pose = BodyPose.zeros(FRAMES)
    angles, orient, transl = pose.body.clone(), pose.global_orient.clone(), pose.transl.clone()
    orient[:, 0] = torch.pi  # feet down in axes whose y points down; facing the camera at -z
    angles[:, 15, 2], angles[:, 16, 2] = -1.1, 1.1
    angles[:, 17, 1], angles[:, 18, 1] = -0.4 - 0.8 * t, 0.5
    angles[:, 1, 0], angles[:, 4, 0] = -0.9 * t, 1.2 * t
    transl[:, 0], transl[:, 2] = -0.15 + 0.3 * t, 3.0
    return pose.replace(global_orient=orient, body=angles, transl=transl)


def seen_by(cameras: list[Camera], pose: BodyPose) -> Landmarks:
    """What a perfect detector would see of the body; marks that the fit does not use stay 0."""
    points = points_of(body())
    vertices, joints = body().shaped(pose.betas)
    transforms = body().skinning_transforms(pose)
    rows = points.vertices
    places = torch.cat(
        (
            transform_points(transforms[:, points.joints], joints[points.joints]),
            skin(vertices[rows], transforms, body().skinning_weights[rows]),
        ),
        1,
    )
    marks = list(points.landmarks)
    image, world = torch.zeros(2, len(cameras), 33, 3)
    for i, view in enumerate(cameras):
        image[i, marks, :2] = view.project(places[i])[0]
        image[i, marks, 2] = 1.0
        world[i, marks] = places[i] @ view.world_to_camera[:3, :3].mT
    hips = world[:, [23, 24]].mean(1, keepdim=True)
    return Landmarks(image, world - hips)


@cache
def static_fit() -> BodyFit:
    cameras = [camera()] * FRAMES
    return fit_body(body(), Observations(seen_by(cameras, truth()), cameras), options=QUICK)


def joint_errors(found: BodyPose, true: BodyPose) -> Tensor:
    """Distance of each of the 22 body joints, metres, [F, 22]."""
    with torch.no_grad():
        apart = body()(found).joints[:, :22] - body()(true).joints[:, :22]
    return apart.norm(dim=-1)


def test_a_known_pose_is_found() -> None:
    fit = static_fit()
    assert fit.residual_px.max() < 3.0
    errors = joint_errors(fit.poses, truth())
    assert errors.mean() < 0.04
    assert errors.max() < 0.12
    assert fit.report["frames_with_landmarks"] == FRAMES
    assert fit.scene_scale == 1.0
    assert fit.poses.hand_pose_convention == "flat"
    off = fit.poses.transl[:, 2] - truth().transl[:, 2]
    assert (off.abs() < fit.errors.distance).all() and (fit.errors.distance < 1).all()
    # a third of a second hardly shows depth: the network's error lasts longer
    assert (errors[:, 16:22].mean(1) < fit.errors.joints).all() and (fit.errors.joints < 0.4).all()


def test_landmarks_that_are_surer_in_space_are_followed_more_closely() -> None:
    """Those of one arm are twelve pixels off in the image, and right in space."""
    cameras = [camera()] * FRAMES
    seen = seen_by(cameras, truth())
    image = seen.image.clone()
    image[:, 13:23:2, :2] += 12.0
    off = []
    for spread in (0.1, 0.02):
        marks = replace(seen, image=image, spread=spread)
        found = fit_body(body(), Observations(marks, cameras), options=QUICK)
        off.append(float(joint_errors(found.poses, truth())[:, [18, 20]].mean()))
    assert off[1] < 0.8 * off[0]


def test_a_fit_whose_errors_nothing_tells_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object) -> None:
        raise torch.linalg.LinAlgError("the input is not positive-definite")

    monkeypatch.setattr(NormalEquations, "draws", fail)
    cameras = [camera()] * FRAMES
    fit = fit_body(body(), Observations(seen_by(cameras, truth()), cameras), options=QUICK)
    assert fit.residual_px.max() < 3.0
    assert fit.errors.joints.isnan().all() and fit.errors.distance.isnan().all()


def test_a_known_height_scales_the_body_and_its_distance() -> None:
    cameras, landmarks = [camera()] * FRAMES, seen_by([camera()] * FRAMES, truth())
    fit = fit_body(body(), Observations(landmarks, cameras), options=replace(QUICK, mean_size=0.92))
    usual = static_fit()
    assert fit.residual_px.max() < 3.0
    nearer = fit.poses.transl[:, 2] / usual.poses.transl[:, 2]
    assert nearer.mean() == pytest.approx(0.92, abs=0.015)
    assert (fit.errors.distance < 0.5 * usual.errors.distance).all()
    assert 1.5 < stature(body()) < 1.9


@pytest.mark.parametrize(
    ("seen", "stray"),
    [
        ("#######....#...######....##", "...........#..............."),  # its end may go on
        ("#####..#..#####", "..............."),  # gaps of two frames
        ("#....#####....#", "..............."),  # too many of them: that is how they are seen
    ],
)
def test_landmarks_that_stand_alone_are_not_believed(seen: str, stray: str) -> None:
    image = torch.zeros(len(seen), 33, 3)
    image[[frame == "." for frame in seen]] = torch.nan
    landmarks = Landmarks(image, image.clone())
    found = landmarks.strays()
    assert "".join("#" if frame else "." for frame in found) == stray
    assert (landmarks.without(found).found == (landmarks.found & ~found)).all()


def test_landmarks_off_the_way_are_not_believed() -> None:
    """Shoulders that walk to the right, are lost, and are found somewhere else for a while."""
    frames = torch.arange(40.0)
    image, lost = torch.zeros(40, 33, 3), slice(14, 18)
    image[:, 11, 0], image[:, 12, 0] = 50 + 3 * frames, 10 + 3 * frames
    image[:, :, 1] = 20.0
    image[[18, 19, 21], :, 1] += 30
    image[32, :, 1] += 30  # no gap is near: the person may have jumped
    image[lost] = torch.nan
    jumps = Landmarks(image, image.clone()).jumps()
    assert jumps.nonzero()[:, 0].tolist() == [18, 19, 21]
    image[lost] = 0.0
    assert not Landmarks(image, image.clone()).jumps().any()


def test_every_frame_without_landmarks_has_its_reason() -> None:
    image = torch.zeros(12, 33, 3)
    image[[1, 2, 3, 4, 7]] = torch.nan
    image[4, :4] = 0.0  # some, and too few
    given = Landmarks(image, image.clone())
    fates = FrameFates.at(  # of frames of the video, every second one of which was chosen
        {"dark": (2, 3, 4, 16), "cut": (5,)}, {"second look": (14, 18, 20)}, range(0, 24, 2)
    )
    assert fates == FrameFates({"dark": [1, 2, 8]}, {"second look": [7, 9, 10]})
    dropped = torch.zeros(12, dtype=torch.bool)
    dropped[10] = True
    found = fates.complete(given, {"alone": dropped})
    few, none = "fewer than 8 of the body's landmarks were found", "the source has no landmarks"
    assert found.lost == {"dark": [1, 2], few: [4], none: [3, 7], "alone": [10]}
    assert found.repaired == {"second look": [9]}  # 7 and 10 are lost
    assert found.lost_frames() == [1, 2, 3, 4, 7, 10]
    lost, repaired = fates_said(found, 12)
    assert "6 of 12" in lost and "dark in 2 (1-2)" in lost and "second look in 1 (9)" in repaired
    assert fates_said(FrameFates(), 12) == []


def test_frames_without_landmarks_lie_between_their_neighbours() -> None:
    cameras = [camera()] * FRAMES
    landmarks = seen_by(cameras, truth())
    image, world = landmarks.image.clone(), landmarks.world.clone()
    image[4:6] = torch.nan
    world[4:6] = torch.nan
    fit = fit_body(body(), Observations(Landmarks(image, world), cameras), options=QUICK)
    assert torch.isnan(fit.residual_px[4:6]).all()
    assert torch.isfinite(fit.residual_px[[0, 1, 2, 3, 6, 7, 8]]).all()
    assert fit.report["frames_with_landmarks"] == FRAMES - 2
    for field in (fit.poses.body, fit.poses.transl, fit.poses.global_orient):
        assert torch.isfinite(field).all()
    # arms do not rise to the T-pose, the elbow goes on bending
    assert joint_errors(fit.poses, truth())[4:6].mean() < 0.06


def test_first_and_last_frames_may_be_unseen() -> None:
    cameras = [camera()] * FRAMES
    landmarks = seen_by(cameras, truth())
    image = landmarks.image.clone()
    image[[0, 1, FRAMES - 1]] = torch.nan
    fit = fit_body(body(), Observations(replace(landmarks, image=image), cameras), options=QUICK)
    assert joint_errors(fit.poses, truth()).mean() < 0.08
    assert fit.errors.joints[[0, FRAMES - 1]].min() > fit.errors.joints[3:6].max()


def test_an_outlier_landmark_is_outvoted() -> None:
    cameras = [camera()] * FRAMES
    landmarks = seen_by(cameras, truth())
    image = landmarks.image.clone()
    image[4, 15, :2] += torch.tensor([200.0, -150.0])  # one wrist, one frame
    fit = fit_body(body(), Observations(Landmarks(image, landmarks.world), cameras), options=QUICK)
    errors = joint_errors(fit.poses, truth())
    assert errors[4, 20] < 0.12
    assert errors.mean() < 0.04  # nor does it pull the body nearer or change its size


def walking_camera(unit: float) -> tuple[list[Camera], list[Camera]]:
    """Cameras in metres, and the same in units of `unit` metres."""
    metric = [camera((0.05 * i, 0.0, 0.02 * i)) for i in range(FRAMES)]
    own = [camera(tuple((c.center / unit).tolist())) for c in metric]
    return metric, own


def test_scene_scale_from_the_ground_at_the_feet() -> None:
    unit = 0.25
    metric, own = walking_camera(unit)
    pose = truth()
    with torch.no_grad():
        floor = float(body()(pose).vertices[..., 1].max())
    x, z = torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(2, 5, 61), indexing="xy")
    ground = torch.stack((x, torch.full_like(x, floor), z), -1).reshape(-1, 3)
    fit = fit_body(
        body(), Observations(seen_by(metric, pose), own, points=ground / unit),
        options=replace(QUICK, scale=True),
    )  # fmt: skip
    assert fit.scene_scale == pytest.approx(unit, rel=0.06)
    assert "ground" in fit.report["scene_scale_from"]
    # in the metric world that the scale makes, the body is where it was
    assert joint_errors(fit.poses, pose).mean() < 0.08
    assert fit.residual_px.max() < 4.0


def test_scene_scale_without_points_comes_from_still_feet() -> None:
    unit = 0.25
    metric, own = walking_camera(unit)
    pose = truth()
    still = pose.replace(transl=pose.transl[:1].expand(FRAMES, 3), body=pose.body[:1].expand(
        FRAMES, 21, 3))  # fmt: skip
    fit = fit_body(
        body(), Observations(seen_by(metric, still), own), options=replace(QUICK, scale=True)
    )
    assert fit.scene_scale == pytest.approx(unit, rel=0.1)
    assert "still" in fit.report["scene_scale_from"]


def test_ground_scale_needs_points_near_the_feet() -> None:
    feet = torch.tensor([[[0.0, 0.8, 3.0]]]).expand(5, 1, 3)
    cameras, seen = [camera()] * 5, torch.ones(5, dtype=torch.bool)
    floor = torch.tensor([[0.1 * i, 0.8 + 0.01 * i, 3.0] for i in range(-3, 4)])
    found = ground_scale(feet, floor * 4, cameras, seen)  # four units a metre
    assert found is not None
    assert found[0] == pytest.approx(0.25, rel=1e-5) and found[1] == 5
    assert ground_scale(feet, floor * 4, cameras, torch.zeros(5, dtype=torch.bool)) is None
    above = floor - torch.tensor([0.0, 1.5, 0.0])
    assert ground_scale(feet, above, cameras, seen) is None


def test_limbs_start_on_their_landmarks() -> None:
    """The closed form alone gives each limb its directions, in any orientation of the torso."""
    pose = truth()
    landmarks = seen_by([camera()] * FRAMES, pose)
    torso = axis_angle_to_matrices(pose.global_orient)
    angles = limb_pose(landmarks.world, torso)
    with torch.no_grad():
        ours = body()(pose.replace(body=angles)).joints
        true = body()(pose).joints
    for a, b in ((16, 18), (18, 20), (17, 19), (19, 21), (1, 4), (4, 7), (2, 5), (5, 8)):
        way = torch.nn.functional.normalize(ours[:, b] - ours[:, a], dim=-1)
        goal = torch.nn.functional.normalize(true[:, b] - true[:, a], dim=-1)
        assert (way * goal).sum(-1).min() > np.cos(np.deg2rad(3)), (a, b)
    assert limit_penalty(angles) < 0.02  # elbows and knees bend the way they can


def limit_penalty(body: Tensor) -> Tensor:
    return beyond(body).square().sum((-1, -2)).mean()


def test_joint_limits() -> None:
    straight = torch.zeros(4, 21, 3)
    assert limit_penalty(straight) == 0
    for joint, axis, wrong in ((4, 0, -0.5), (5, 0, -0.5), (18, 1, 0.5), (19, 1, -0.5)):
        bent = straight.clone()
        bent[:, joint - 1, axis] = wrong
        assert limit_penalty(bent) > 0.1  # a knee or elbow that bends backwards
        bent[:, joint - 1, axis] = -2 * wrong
        assert limit_penalty(bent) == 0


def test_mirrored_offsets() -> None:
    points = points_of(body())
    for left, right in ((11, 12), (7, 8), (29, 30)):
        a, b = points.index(left), points.index(right)
        assert points.pairs[a] == points.pairs[b]
        assert points.mirror[a].tolist() == [1, 1, 1] and points.mirror[b].tolist() == [-1, 1, 1]
    assert points.mirror[points.index(0)].tolist() == [0, 1, 1]
    assert (points.pairs == points.pairs[points.index(0)]).sum() == 1


def test_landmark_points_of_the_head_and_feet_are_where_they_belong() -> None:
    points = points_of(body())
    vertices, joints = body().shaped(torch.zeros(10))
    at = {m: vertices[v] for m, v in zip(points.landmarks[len(points.joints) :], points.vertices)}
    assert abs(at[0][0]) < 0.01 and at[0][2] > joints[15][2] + 0.08  # nose: middle, in front
    assert at[7][0] > 0.05 and at[8][0] < -0.05  # ears
    assert at[31][2] - at[29][2] > 0.18 and at[32][2] - at[30][2] > 0.18  # toe before heel
    assert at[29][0] > 0 > at[30][0]


def test_mediapipe_arrays_and_missing_frames() -> None:
    image = np.ones((3, 33, 4), np.float32) * (1, 2, 3, 0.5)
    world = np.ones((3, 33, 4), np.float32)
    image[1] = np.nan
    image[2, 8:] = np.nan  # of the head, three landmarks have a point of the body
    track = Landmarks.from_mediapipe(image, world)
    assert track.image[0, 0].tolist() == [1.0, 2.0, 0.5]
    assert track.found.tolist() == [True, False, False]
    image[2, 11:18] = 1  # with shoulders, elbows, wrists and one finger it is enough
    world[2, 13] = np.nan
    track = Landmarks.from_mediapipe(image, world)
    assert track.found.tolist() == [True, False, True]
    assert track.solid.tolist() == [True, False, False]


def test_too_little_to_fit_is_refused() -> None:
    cameras = [camera()] * FRAMES
    landmarks = seen_by(cameras, truth())
    with pytest.raises(HoigsError, match=rf"3 .*{FRAMES} "):
        fit_body(body(), Observations(landmarks, cameras[:3]))
    image = landmarks.image.clone()
    image[1:] = torch.nan
    with pytest.raises(HoigsError, match=r"1 of 9 .* 2"):
        fit_body(body(), Observations(replace(landmarks, image=image), cameras))


def test_overlay_paints_the_mesh_and_nothing_else() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    view = camera()
    vertices = body()(truth().frame(0)).vertices
    before = image.copy()
    painted = overlay_frame(image, view, vertices.detach(), body().faces)
    assert (image == before).all()
    changed = (painted != image).any(-1)
    pixels, _ = view.project(vertices)
    low, high = pixels.min(0).values, pixels.max(0).values
    rows, columns = np.nonzero(changed)
    assert abs(columns.min() - float(low[0])) < 3 and abs(columns.max() - float(high[0])) < 3
    assert abs(rows.min() - float(low[1])) < 3 and abs(rows.max() - float(high[1])) < 3
    behind = overlay_frame(
        image, view, vertices.detach() * torch.tensor([1, 1, -1.0]), body().faces
    )
    assert (behind == image).all()  # a body behind the camera leaves no trace


@pytest.mark.slow
def test_real_landmarks_of_a_juggler(shared_data) -> None:
    """MediaPipe's landmarks of a real clip: every eighth frame, 12 px at 1280 is the bar."""
    arrays = np.load(shared_data / "juggle" / "pose_mediapipe.npz")
    image, world = arrays["image_xyzv"][::8], arrays["world_xyzv"][::8]
    K = torch.tensor([[1536.0, 0, 640], [0, 1536.0, 360], [0, 0, 1]])
    cameras = [Camera(K, torch.eye(4), 1280, 720)] * len(image)
    landmarks = Landmarks.from_mediapipe(image, world)
    fit = fit_body(body(), Observations(landmarks, cameras, torch.arange(len(image)) / 3))
    assert fit.report["landmark_error_px"] < 12
    assert fit.report["landmark_offset_m_largest"] < 0.12  # errors are not explained away
    assert limit_penalty(fit.poses.body) < 0.05
    depth = fit.poses.transl[:, 2]
    assert depth.min() > 3.5 and depth.max() < 5.0


def test_offsets_are_as_likely_on_a_small_body_as_on_a_large_one() -> None:
    """And the prior's equations are its derivatives."""
    cameras = [camera()] * FRAMES
    problem = FitProblem(
        body(),
        Observations(seen_by(cameras, truth()), cameras, torch.arange(FRAMES) / 24),
        QUICK,
    )  # fmt: skip
    draw = torch.Generator().manual_seed(0)
    pairs = len(problem.offset_spread)
    start = problem.begin
    offsets = torch.randn(pairs, 3, generator=draw, dtype=torch.float64) * 0.05
    betas = torch.randn(body().num_betas, generator=draw, dtype=torch.float64)
    size, _ = problem.kinematics.size(betas)

    def at(betas: Tensor, offsets: Tensor, unit: float) -> Unknowns:
        return replace(start, pose=start.pose.replace(betas=betas), offsets=offsets, unit=unit)

    shape_alone = problem._shared_priors(at(betas, 0 * offsets, 0.0), None)
    mean = problem._shared_priors(at(0 * betas, offsets, 0.0), None)
    other = problem._shared_priors(at(betas, size * offsets, 0.0), None)
    assert other - shape_alone == pytest.approx(mean)
    count = len(betas) + offsets.numel() + 2
    equations = NormalEquations(1, 1, count)
    problem._shared_priors(at(betas, offsets, 0.01), equations)
    by = torch.randn(count, generator=draw, dtype=torch.float64) * 1e-6
    by[-1] = 0.0
    costs = [
        problem._shared_priors(
            at(
                betas + s * by[: len(betas)],
                offsets + s * by[len(betas) : -2].view(-1, 3),
                0.01 + s * float(by[-2]),
            ),
            None,
        )
        for s in (1, -1)
    ]
    assert (costs[0] - costs[1]) / 4 == pytest.approx(float(equations.by_shared @ by), rel=1e-5)


def test_a_bent_elbow_may_twist() -> None:
    """The axis-angle of both turns together has a z component, which is no bend of its own."""
    bend, twist = torch.tensor([0.0, -1.4, 0.0]), torch.tensor([-0.6, 0.0, 0.0])
    quats = multiply_quats(axis_angle_to_quats(bend), axis_angle_to_quats(twist))
    turns = torch.zeros(1, 21, 3)
    turns[:, 17] = quats_to_axis_angle(quats)
    assert turns[0, 17, 2].abs() > 0.3 and limit_penalty(turns) == 0


def test_landmarks_of_a_network_that_looks_at_the_hips_are_turned_to_the_camera() -> None:
    pose = truth()
    cameras, aside = [camera()] * FRAMES, pose.transl.clone()
    aside[:, 0] -= 1.2  # 22 degrees off the camera's axis
    seen = seen_by(cameras, pose.replace(transl=aside))
    ray = torch.tensor([-0.4, 0.0, 1.0])
    angle = torch.atan2(ray[0], ray[2])
    turned = seen.world @ axis_angle_to_matrices(torch.stack((angle * 0, angle, angle * 0)))
    K = torch.stack([c.K for c in cameras])
    middle = torch.tensor([FOCAL * -0.4 + WIDTH / 2, HEIGHT / 2])
    image = seen.image.clone()
    image[:, [23, 24], :2] = middle
    given = Landmarks(image, turned, to_hips=True)
    assert torch.allclose(given.in_cameras(K).world, seen.world, atol=1e-5)
    assert torch.equal(seen.in_cameras(K).world, seen.world), "they are the camera's already"
