"""F25, F26, F27, F31: direct checks of skinning, hand conventions, body models, protocols."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch

from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.maths.skinning import ancestor_table, skin, skin_quats
from hoigs.core.model.smpl_params import hand_convention
from hoigs.core.values.clip import BodyTrack
from hoigs.core.values.moment import BodyPose
from hoigs.evaluation.protocol import Protocol
from hoigs.plugins.bodies.corrected import require_gender
from hoigs.plugins.bodies.linear import LinearBody
from hoigs.studies.stress.case import CheckResult


def twisted_covariances() -> CheckResult:
    """A capsule of two bones twisted by 180 degrees: rotations and covariances of its Gaussians."""
    around = torch.linspace(0, 2 * math.pi, 25)[:-1]
    along = torch.linspace(0, 1, 21)
    grid = torch.cartesian_prod(along, around)
    points = torch.stack((grid[:, 0], 0.1 * grid[:, 1].cos(), 0.1 * grid[:, 1].sin()), 1)
    share = ((points[:, 0] - 0.3) / 0.4).clamp(0, 1)
    weights = torch.stack((1 - share, share), 1)
    transforms = torch.eye(4).repeat(2, 1, 1)
    transforms[1, :3, :3] = axis_angle_to_matrices(torch.tensor([math.radians(179.9), 0, 0]))
    parents = (-1, 0)
    turns = quats_to_matrices(skin_quats(transforms, weights, parents, ancestor_table(parents)))
    proper = float((turns @ turns.mT - torch.eye(3)).abs().max())
    covariances = turns @ torch.diag(torch.tensor([0.04, 0.01, 0.0004])) @ turns.mT
    least = float(torch.linalg.eigvalsh(covariances).min())
    ring = skin(points, transforms, weights)[(along.shape[0] // 2) * 24 :][:24]
    blended = (weights @ transforms[:, :3, :3].flatten(1)).unflatten(1, (3, 3))
    collapsed = float(torch.linalg.det(blended).abs().min())
    return CheckResult(
        proper < 1e-4 and least > 1e-5,
        f"averaged quaternions are rotations (off by {proper:.1g}), covariances positive (least "
        f"{least:.2g}); averaged matrices have a determinant of {collapsed:.1g}; the skin's radius "
        f"in the middle is {100 * float(ring[:, 1:].norm(dim=1).mean()) / 0.1:.0f} % of itself, "
        "as linear blend skinning has it",
    )


class _MeanHands(LinearBody):
    """A body of one point a joint whose mean hand is a half-closed fist."""

    def __init__(self) -> None:
        joints = torch.arange(52.0)[:, None] * torch.tensor([0.02, 0.0, 0.0])
        parents = [-1, *range(51)]
        super().__init__(
            template=joints + torch.tensor([0.0, 0.03, 0.0]),
            shape_directions=torch.zeros(2, 52, 3),
            joints=joints,
            joint_shape_directions=torch.zeros(2, 52, 3),
            weights=torch.eye(52),
            faces=torch.tensor([[0, 1, 2]]),
            joint_names=[f"joint{i}" for i in range(52)],
            parents=parents,
        )

    def flat_hands(self, pose: BodyPose) -> BodyPose:
        if pose.hand_pose_convention == "flat":
            return pose
        mean = torch.tensor([0.0, 0.0, 0.5]).to(pose.left_hand)
        return pose.replace(
            left_hand=pose.left_hand + mean, right_hand=pose.right_hand - mean,
            hand_pose_convention="flat",
        )  # fmt: skip


def hand_convention_found() -> CheckResult:
    """Hand poses relative to a flat or a mean hand: the convention is found from the joints."""
    body, found = _MeanHands(), []
    pose = BodyPose.zeros(4, betas=2)
    bent = 0.1 * torch.randn(pose.left_hand.shape, generator=torch.Generator().manual_seed(0))
    pose = pose.replace(left_hand=bent, right_hand=-bent)
    for convention in ("flat", "mean"):
        written = pose.replace(hand_pose_convention=convention)
        found.append(hand_convention(body, pose, body(written).joints) == convention)
    try:
        hand_convention(body, pose, body(pose).joints + 0.5)
        refused = False
    except ClipError:
        refused = True
    return CheckResult(
        all(found) and refused, f"found: {found}; joints of neither are refused: {refused}"
    )


def gender_refused() -> CheckResult:
    """Poses of one gender with the body model of another."""
    refused = {}
    for wanted in ("male", "female", "neutral"):
        track = BodyTrack("body:smplx", BodyPose.zeros(1), gender=wanted)
        for given in ("male", "female", "neutral"):
            try:
                require_gender("body:smplx", Path(f"SMPLX_{given.upper()}.npz"), track)
                refused[wanted, given] = False
            except HoigsError:
                refused[wanted, given] = True
    wrong = sum(was for (a, b), was in refused.items() if a != b)
    taken = sum(not was for (a, b), was in refused.items() if a == b)
    return CheckResult(
        wrong == 6 and taken == 3,
        f"{wrong} of 6 wrong pairs refused, {taken} of 3 right ones accepted",
    )


def fitted_poses_are_declared() -> CheckResult:
    """Scores with test poses fitted to test images have another protocol, and a warning."""
    given = Protocol(
        views="training cameras", split="test", frames=4, unseen_times=4, region="full", band=2,
        test_pose="given", pixels="float", width=64, height=64, lpips_net=None, device="cpu",
        rasterizer="warp",
    )  # fmt: skip
    fitted = replace(given, test_pose="fitted", fit_steps=40)
    warned = any("FITTED TO TEST IMAGES" in line for line in fitted.footnotes())
    silent = not any("FITTED" in line for line in given.footnotes())
    differ = sorted(k for k, v in fitted.to_dict().items() if given.to_dict()[k] != v)
    return CheckResult(
        warned and silent and "test_pose" in differ,
        f"protocols differ in {', '.join(differ)}; warned: {warned}",
    )
