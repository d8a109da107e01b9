"""What the body fit's steps rest on: derivatives in closed form and the banded solution."""

from __future__ import annotations

import pytest
import torch
from test_body_fit import FRAMES, QUICK, body, camera, seen_by, truth
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body import fit_problem
from hoigs.preparation.body.fit_problem import FitProblem, Observations
from hoigs.preparation.body.kinematics import PER_FRAME, Kinematics, NormalEquations
from hoigs.preparation.body.landmarks import points_of
from hoigs.preparation.body.priors import MotionPrior

STEP = 1e-6


def some_pose(frames: int) -> BodyPose:
    draw = torch.Generator().manual_seed(0)
    pose = BodyPose.zeros(frames).replace(
        body=0.4 * torch.randn(frames, 21, 3, generator=draw),
        global_orient=torch.randn(frames, 3, generator=draw),
        transl=torch.randn(frames, 3, generator=draw),
        betas=torch.randn(body().num_betas, generator=draw),
    )
    return pose.to(torch.float64)


def moved(pose: BodyPose, by: Tensor, betas: Tensor) -> BodyPose:
    turn = axis_angle_to_matrices(pose.global_orient) @ axis_angle_to_matrices(by[:, 3:6])
    return pose.replace(
        transl=pose.transl + by[:, :3],
        global_orient=matrices_to_axis_angle(turn),
        body=pose.body + by[:, 6:].unflatten(-1, (21, 3)),
        betas=pose.betas + betas,
    )


def test_points_move_by_their_derivatives() -> None:
    points = points_of(body())
    kinematics = Kinematics(body(), points.joints, points.vertices)
    pose, shift = some_pose(2), torch.zeros(len(points.landmarks), 3, dtype=torch.float64)
    at = kinematics.posed(pose, shift)
    for seed in range(3):
        draw = torch.Generator().manual_seed(seed)
        by = torch.randn(2, PER_FRAME, generator=draw, dtype=torch.float64)
        betas = torch.randn(len(pose.betas), generator=draw, dtype=torch.float64)
        ahead, behind = (
            kinematics.posed(moved(pose, s * by, s * betas), shift, False).points
            for s in (STEP, -STEP)
        )
        expected = (at.by_frame @ by[:, None, :, None])[..., 0] + at.by_betas @ betas
        torch.testing.assert_close((ahead - behind) / (2 * STEP), expected, rtol=1e-5, atol=1e-6)


def test_the_motion_prior_moves_by_its_gradient() -> None:
    points = points_of(body())
    kinematics = Kinematics(body(), points.joints, points.vertices)
    count = len(points.landmarks)
    times = torch.tensor([0.0, 0.1, 0.15, 0.3, 0.5])
    prior = MotionPrior(kinematics, [0, 1], count, times, 3.0)
    pose, shift = some_pose(5), torch.zeros(count, 3, dtype=torch.float64)
    equations = NormalEquations(5, PER_FRAME, len(pose.betas))
    at = kinematics.posed(pose, shift)
    prior.points(at, at.by_betas, pose, 0, equations)
    prior.angles(pose, equations)
    draw = torch.Generator().manual_seed(1)
    by = torch.randn(5, PER_FRAME, generator=draw, dtype=torch.float64)
    betas = torch.randn(len(pose.betas), generator=draw, dtype=torch.float64)
    costs = []
    for s in (STEP, -STEP):
        changed = moved(pose, s * by, s * betas)
        there = kinematics.posed(changed, shift, False)
        costs.append(prior.points(there, None, changed, 0, None) + prior.angles(changed, None))
    # the cost is twice the sum that the equations are of
    expected = 2 * float((equations.by_frame * by).sum() + equations.by_shared @ betas)
    assert abs((costs[0] - costs[1]) / (2 * STEP) - expected) < 1e-4 * abs(expected)


def test_a_step_solves_the_whole_system() -> None:
    """The banded, bordered solution against a dense one of the same residuals."""
    frames, width, shared = 5, 4, 3
    draw = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    own, across = random(frames, 6, width), random(frames, 6, width)
    own_shared, across_shared = random(frames, 6, shared), random(frames, 6, shared)
    residuals, accelerations, factors = random(frames, 6), random(frames - 2, 6), random(3, 3)
    equations = NormalEquations(frames, width, shared)
    equations.add(residuals, torch.ones(frames, 6), own, own_shared)
    equations.add_accelerations(
        accelerations, torch.full((3, 6), 2.0), factors, across, across_shared
    )
    jacobian = torch.zeros(frames * 6 + 18, frames * width + shared, dtype=torch.float64)
    for t in range(frames):
        rows = slice(6 * t, 6 * t + 6)
        jacobian[rows, width * t : width * (t + 1)] = own[t]
        jacobian[rows, -shared:] = own_shared[t]
    for t in range(3):
        rows = slice(6 * (frames + t), 6 * (frames + t) + 6)
        for k in range(3):
            part = factors[t, k] * across[t + k]
            jacobian[rows, width * (t + k) : width * (t + k + 1)] = part
            jacobian[rows, -shared:] += factors[t, k] * across_shared[t + k]
    weights = torch.cat((torch.ones(frames * 6), torch.full((18,), 2.0))).double()
    values = torch.cat((residuals.flatten(), accelerations.flatten()))
    dense = torch.linalg.solve(jacobian.T * weights @ jacobian, -(jacobian.T * weights @ values))
    found = equations.step(0.0)
    assert found is not None
    torch.testing.assert_close(torch.cat((found[0].flatten(), found[1])), dense)
    # draws spread as the inverse of the matrix says, and no otherwise in any direction
    inverse = torch.linalg.inv(jacobian.T * weights @ jacobian)
    rows = [torch.cat((a.flatten(), b)) for a, b in equations.draws(4000, draw)]
    spread = torch.linalg.solve_triangular(
        torch.linalg.cholesky(inverse), torch.stack(rows).T, upper=False
    ).cov()
    torch.testing.assert_close(spread, torch.eye(len(spread)).double(), atol=0.12, rtol=0)


def test_derivatives_of_a_few_frames_at_a_time_give_the_same_equations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Accelerations reach over the borders of such parts."""
    cameras = [camera()] * FRAMES
    problem = FitProblem(body(), Observations(seen_by(cameras, truth()), cameras), QUICK)
    found = []
    for at_once in (FRAMES, 4, 1):
        monkeypatch.setattr(fit_problem, "AT_ONCE", at_once)
        shared = problem.begin.pose.betas.numel() + problem.begin.offsets.numel() + 2
        equations = NormalEquations(FRAMES, PER_FRAME, shared)
        energy = problem.energy(problem.begin, 1.0, equations)
        found.append((
            torch.tensor(energy), *equations.blocks, equations.border, equations.by_frame,
            equations.shared, equations.by_shared,
        ))  # fmt: skip
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], rtol=1e-9, atol=1e-9)
