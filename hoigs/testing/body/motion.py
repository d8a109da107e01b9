"""B07 to B13: skinning of one pose and of batches, gradients."""

from __future__ import annotations

import torch

from hoigs.core.interfaces.body import LEFT_WRIST, PELVIS
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.maths.skinning import transform_points
from hoigs.testing.body.subject import CHECKS, BodySubject
from hoigs.testing.compare import require, require_close
from hoigs.testing.modules import require_true_gradients, unchanged, weighted_sum

FIELDS = ("global_orient", "body", "left_hand", "right_hand", "transl", "betas")


@CHECKS.check("B07")
def zero_pose_is_the_rest_pose(subject: BodySubject) -> None:
    """The zero pose does not move the shaped body, and its transforms are the identity."""
    body, zero = subject.body, subject.zero()
    pose = zero.replace(betas=subject.pose().betas)
    vertices, joints = body.shaped(pose.betas)
    output = body(pose)
    require_close("vertices", output.vertices, vertices, atol=1e-5)
    require_close("joints", output.joints, joints, atol=1e-5)
    transforms = body.skinning_transforms(pose)
    require_close("transforms", transforms, torch.eye(4).expand_as(transforms), atol=1e-5)


@CHECKS.check("B08")
def the_pelvis_is_the_root(subject: BodySubject) -> None:
    """The pelvis is at J_0 + transl; global_orient rotates the whole body about it."""
    body, pose = subject.body, subject.pose()
    output = body(pose)
    root = body.shaped(pose.betas)[1][PELVIS]
    require_close("the pelvis", output.joints[PELVIS], root + pose.transl, atol=1e-5)
    still = body(pose.replace(global_orient=torch.zeros_like(pose.global_orient)))
    turn = axis_angle_to_matrices(pose.global_orient).double()
    center = still.joints[PELVIS].double()
    turned = (still.vertices.double() - center) @ turn.mT + center
    require_close("vertices, turned as a whole", output.vertices, turned, atol=1e-4)


@CHECKS.check("B09")
def joints_follow_their_transforms(subject: BodySubject) -> None:
    """Joints follow their transforms; rotating an elbow moves that forearm only."""
    body, pose = subject.body, subject.pose()
    output, transforms = body(pose), body.skinning_transforms(pose)
    expected = transform_points(transforms, body.shaped(pose.betas)[1])
    require_close("joints", output.joints, expected, atol=1e-5)
    bent = pose.body.clone()
    bent[17, 2] += 0.8  # the left elbow
    moved = (body(pose.replace(body=bent)).joints - output.joints).norm(dim=-1)
    require(moved[LEFT_WRIST] > 0.05, "bending the left elbow does not move the left wrist")
    arm = {20, *range(len(body.parents) - 30, len(body.parents) - 15)}
    others = [i for i in range(len(body.parents)) if i not in arm]
    require_close("joints off the left forearm", moved[others], torch.zeros(len(others)), atol=1e-4)


@CHECKS.check("B10")
def a_batch_is_a_loop(subject: BodySubject) -> None:
    """A batch of poses gives the same as each pose alone."""
    body = subject.body
    poses = [subject.pose(time) for time in (0.0, 0.4, 0.9)]
    fields = {name: torch.stack([getattr(p, name) for p in poses]) for name in FIELDS[:-1]}
    stacked = poses[0].replace(**fields)
    together, transforms = body(stacked), body.skinning_transforms(stacked)
    for i, pose in enumerate(poses):
        alone = body(pose)
        require_close(f"vertices of pose {i}", together.vertices[i], alone.vertices, atol=1e-5)
        require_close(f"joints of pose {i}", together.joints[i], alone.joints, atol=1e-5)
        single = body.skinning_transforms(pose)
        require_close(f"transforms of pose {i}", transforms[i], single, atol=1e-5)


@CHECKS.check("B11")
def gradients_are_derivatives(subject: BodySubject) -> None:
    """In float64, gradients of pose, translation and shape agree with differences."""
    body, dtype = subject.body, torch.float64
    pose = subject.pose(dtype=dtype)
    leaves = {name: getattr(pose, name).clone().requires_grad_() for name in FIELDS}
    moved = pose.replace(**leaves)

    def loss() -> torch.Tensor:
        output = body(moved)
        return weighted_sum({"vertices": output.vertices[::7], "joints": output.joints})

    require_true_gradients(leaves, loss)
    slopes = torch.autograd.grad(loss(), list(leaves.values()))
    for name, slope in zip(FIELDS, slopes, strict=True):
        require(bool((slope != 0).any()), f"{name} gets no gradient")


@CHECKS.check("B12")
def dtype_is_that_of_the_pose(subject: BodySubject) -> None:
    """It computes in the dtype of the pose."""
    for dtype in (torch.float32, torch.float64):
        output = subject.body(subject.pose(dtype=dtype))
        for name, x in vars(output).items():
            require(x.dtype == dtype, f"{name} are {x.dtype} for a pose of {dtype}")


@CHECKS.check("B13")
def poses_are_not_modified(subject: BodySubject) -> None:
    """The pose is not written to, and does not affect later calls."""
    body, pose = subject.body, subject.pose()
    with unchanged("pose.", {name: getattr(pose, name) for name in FIELDS}):
        first = body(pose).vertices.clone()
        body(subject.pose(0.9))
        require_close("vertices of a second call", body(pose).vertices, first, atol=1e-6)
