"""B01 to B06: joints, parts, weights and the surface, in the rest pose."""

from __future__ import annotations

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
)
from hoigs.testing.body.subject import CHECKS, BodySubject
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.material.body import SMPLX_PARENTS

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
