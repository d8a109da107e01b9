"""Conformance of body models: `CHECKS`, on poses of a small skeleton."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch

from hoigs.core.interfaces.body import (
    BODY_JOINT_PARTS,
    LEFT_FOOT,
    LEFT_SHOULDER,
    LEFT_WRIST,
    PART_NAMES,
    PELVIS,
    RIGHT_FOOT,
    RIGHT_SHOULDER,
    RIGHT_WRIST,
    BodyModel,
)
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.maths.skinning import transform_points
from hoigs.core.values.moment import BodyPose
from hoigs.testing.checks import CheckList, require, require_close, require_finite
from hoigs.testing.material import HUMAN, SMPLX_PARENTS, pose_at, tiny_clip
from hoigs.testing.modules import DeviceSubject, require_true_gradients, unchanged, weighted_sum
from hoigs.testing.runner import Options


class BodySubject(DeviceSubject[BodyModel]):
    """The component under check."""

    @cached_property
    def body(self) -> BodyModel:
        body = self.cls.from_config(self.config, BuildContext(HUMAN, tiny_clip()))
        return body.to(self.device)

    def pose(self, time: float = 0.3, dtype: torch.dtype = torch.float32) -> BodyPose:
        """Every joint rotated a little, a translation, and nonzero betas."""
        betas = 0.5 * torch.cos(torch.arange(self.body.num_betas, dtype=torch.float64))
        return pose_at(time).replace(betas=betas).to(self.device, dtype)

    def zero(self, dtype: torch.dtype = torch.float32) -> BodyPose:
        return BodyPose.zeros(betas=self.body.num_betas, dtype=dtype, device=self.device)


CHECKS: CheckList[BodySubject] = CheckList("B")


def subject(cls: type[BodyModel], config: Any, options: Options) -> BodySubject:
    made = BodySubject(cls, config, torch.device(options.device))
    made.body  # noqa: B018  (raises here when it cannot be built)
    return made


# B01 to B06: joints, parts, weights and the surface, in the rest pose.

HEAD, LEFT_ANKLE = 15, 7


@CHECKS.check("B01")
def joints_are_in_smplx_order(subject: BodySubject) -> None:
    """52 or 55 joints, the first 22 on SMPL-X's tree, then two hands of 15 on the wrists."""
    body = subject.body
    count = len(body.parents)
    require(count in (52, 55), f"there are {count} joints, expected 52, or 55 with jaw and eyes")
    require(len(body.joint_names) == count, f"{len(body.joint_names)} names of {count} joints")
    first = tuple(body.parents[:22])
    require(first == SMPLX_PARENTS, f"parents of the body's joints are {first}")
    for start, wrist in ((count - 30, LEFT_WRIST), (count - 15, RIGHT_WRIST)):
        for joint in range(start, start + 15):
            expected = wrist if (joint - start) % 3 == 0 else joint - 1
            got = body.parents[joint]
            require(got == expected, f"joint {joint} of a hand has parent {got}, not {expected}")


@CHECKS.check("B02")
def it_stands_upright_and_faces_z(subject: BodySubject) -> None:
    """In the zero pose y is up, the left hand at +x, the toes ahead at +z."""
    joints = subject.body.shaped(subject.zero().betas)[1]
    x, y, z = joints.unbind(-1)
    require(y[HEAD] > y[PELVIS] > y[LEFT_FOOT], "head, pelvis and feet do not go down along y")
    require(x[LEFT_WRIST] > x[LEFT_SHOULDER] > x[RIGHT_SHOULDER] > x[RIGHT_WRIST], "left is not +x")
    require(z[LEFT_FOOT] > z[LEFT_ANKLE], "the toes do not point to +z")
    require(x[LEFT_FOOT] > x[RIGHT_FOOT], "the left foot is not at +x")
    level = float((y[LEFT_WRIST] - y[LEFT_SHOULDER]).abs())
    reach = float(x[LEFT_WRIST] - x[LEFT_SHOULDER])
    require(level < 0.5 * reach, "the arms are not stretched out sideways: no T-pose")


@CHECKS.check("B03")
def every_part_has_vertices(subject: BodySubject) -> None:
    """All 16 parts have vertices, each near a joint of its own part."""
    body = subject.body
    vertices, joints = body.shaped(subject.zero().betas)
    parts = body.vertex_parts
    require(parts.shape == (len(vertices),), f"vertex_parts has shape {list(parts.shape)}")
    missing = sorted(set(range(len(PART_NAMES))) - set(parts.tolist()))
    require(not missing, f"no vertex is part of {[PART_NAMES[i] for i in missing]}")
    unknown = sorted(set(parts.tolist()) - set(range(len(PART_NAMES))))
    require(not unknown, f"vertex_parts has {unknown}; parts are 0 to 15")
    owner = torch.tensor(BODY_JOINT_PARTS, device=parts.device)
    apart = torch.cdist(vertices, joints[:22])
    own = torch.where(owner == parts[:, None], apart, torch.inf).amin(1)
    far = [PART_NAMES[i] for i in range(16) if float(own[parts == i].median()) > 0.35]
    require(not far, f"vertices of {far} are over 0.35 m from the joints of that part")


@CHECKS.check("B04")
def weights_blend(subject: BodySubject) -> None:
    """Skinning weights are not negative, and the rows sum to one."""
    body = subject.body
    weights = body.skinning_weights
    shape = (len(body.vertex_parts), len(body.parents))
    require(weights.shape == shape, f"skinning_weights is {list(weights.shape)}, not {shape}")
    require((weights >= 0).all(), "a skinning weight is negative")
    require_close("sum of weights", weights.sum(1), torch.ones(len(weights)), atol=1e-4)


@CHECKS.check("B05")
def the_surface_is_on_the_body(subject: BodySubject) -> None:
    """Points of `surface` match their faces and coordinates, and repeat with the seed."""
    body, betas = subject.body, subject.pose().betas
    vertices = body.shaped(betas)[0]
    for count in (None, 50):
        surface = body.surface(count, betas, 3)
        number = len(vertices) if count is None else count
        require(len(surface.points) == number, f"surface({count}) has {len(surface.points)} points")
        corners = vertices[body.faces[surface.faces]]
        expected = (corners * surface.barycentric[..., None]).sum(1)
        require_close("points", surface.points, expected, atol=1e-4)
        ones = torch.ones(number)
        require_close("length of normals", surface.normals.norm(dim=-1), ones, atol=1e-3)
        require_close("sum of weights", surface.weights.sum(1), ones, atol=1e-3)
        require((surface.spacing > 0).all(), "a spacing is not positive")
    again = body.surface(50, betas, 3)
    require(torch.equal(again.points, surface.points), "the same seed gives other points")


@CHECKS.check("B06")
def betas_shape_the_body(subject: BodySubject) -> None:
    """Every shape coefficient changes the vertices."""
    body = subject.body
    zero = subject.zero().betas
    plain = body.shaped(zero)[0]
    for i in range(body.num_betas):
        one = zero.clone()
        one[i] = 1.0
        vertices = body.shaped(one)[0]
        require_finite(f"vertices with beta {i}", vertices)
        moved = float((vertices - plain).norm(dim=-1).max())
        require(moved > 1e-5, f"beta {i} changes no vertex")


# B07 to B13: skinning of one pose and of batches, gradients.

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
