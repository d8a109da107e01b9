"""D27 to D30: what a deformation declares in `provides`."""

from __future__ import annotations

import torch

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.deformation import (
    ProvidesFace,
    ProvidesField,
    ProvidesSkeleton,
    ProvidesVelocity,
)
from hoigs.core.values.moment import BodyPose
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.deformation.subject import CHECKS, COUNT, DeformationSubject, provides

H = 1e-5


@CHECKS.check("D27", provides("velocity"))
@torch.no_grad()
def velocity_is_the_derivative(subject: DeformationSubject) -> None:
    """`velocity` is the time derivative of the means, up to one common factor."""
    entity = subject.entity(dtype=torch.float64)
    model = entity.deformation
    require(isinstance(model, ProvidesVelocity), "it has no method velocity(canonical, moment)")
    assert isinstance(model, ProvidesVelocity)
    found, expected = [], []
    for time in (0.07, 0.31, 0.68, 0.9):
        found.append(model.velocity(entity.canonical, subject.at(entity, time)))
        require(found[-1].shape == (COUNT, 3), f"velocity has shape {list(found[-1].shape)}")
        after, before = (subject.draw(entity, time + h).means for h in (H, -H))
        expected.append((after - before) / (2 * H))
    got, slope = torch.stack(found), torch.stack(expected)
    factor = (got * slope).sum() / slope.square().sum()
    require(float(factor) > 0, f"velocity is {float(factor):.3g} times the derivative of the means")
    scale = float((factor * slope).abs().max())
    require_close("velocity, in its own unit", got, factor * slope, atol=1e-4 * scale)


@CHECKS.check("D28", provides("field"))
def the_field_describes_every_part(subject: DeformationSubject) -> None:
    """`posed_field` has finite features and moving positions of points on all 16 parts."""
    entity = subject.entity()
    model = entity.deformation
    require(isinstance(model, ProvidesField), "it has no posed_field, field_parts or field_width")
    assert isinstance(model, ProvidesField)
    parts = model.field_parts()
    missing = sorted(set(range(len(PART_NAMES))) - set(parts.tolist()))
    require(not missing, f"no point of the field on {[PART_NAMES[i] for i in missing]}")
    positions = []
    for time in (-0.2, 0.0, 0.6, 1.0, 1.2):
        features, at = model.posed_field(entity.canonical, subject.at(entity, time))
        expected = (len(parts), model.field_width)
        require(features.shape == expected, f"features are {list(features.shape)}, not {expected}")
        require(at.shape == (len(parts), 3), f"positions are {list(at.shape)}")
        require_finite("features of the field", features)
        require_finite("positions of the field", at)
        positions.append(at)
    require(
        (positions[1] - positions[3]).norm(dim=-1).max() > 0.05,
        "its points do not move in the world",
    )


@CHECKS.check("D29", provides("skeleton"))
def the_skeleton_is_where_the_body_is(subject: DeformationSubject) -> None:
    """Anchors, arm length, pose and parts of the Gaussians match the body."""
    entity = subject.entity(40)
    model = entity.deformation
    require(isinstance(model, ProvidesSkeleton), "it lacks a method of ProvidesSkeleton")
    assert isinstance(model, ProvidesSkeleton)
    moment = subject.at(entity, 0.4)
    pose, anchors = model.pose(moment), model.anchors(moment)
    require(isinstance(pose, BodyPose), f"pose is a {type(pose).__name__}")
    require(anchors.shape == (5, 3), f"anchors have shape {list(anchors.shape)}, expected [5, 3]")
    drawn = subject.draw(entity, 0.4).means
    far = float(torch.cdist(anchors, drawn).amin(1).max())
    require(far < 0.5, f"an anchor is {far:.2f} m from every Gaussian")
    arm = float(model.arm_length())
    require(0.2 < arm < 1.5, f"the arm is {arm:.2f} m long; the tiny body's is 0.66 m")
    parts = model.point_parts()
    good = parts.shape == (40,) and bool(((parts >= 0) & (parts < len(PART_NAMES))).all())
    require(good, "point_parts is not a number from 0 to 15 for each Gaussian")


@CHECKS.check("D30", provides("face"))
def the_face_is_rows_with_normals(subject: DeformationSubject) -> None:
    """The face is rows of the Gaussians with unit normals."""
    entity = subject.entity(200)
    model = entity.deformation
    require(isinstance(model, ProvidesFace), "it has no face_points")
    assert isinstance(model, ProvidesFace)
    rows, normals = model.face_points()
    inside = bool(((rows >= 0) & (rows < len(entity))).all())
    require(
        inside and len(set(rows.tolist())) == len(rows),
        "face rows are not distinct rows of the Gaussians",
    )
    require_close("length of the normals", normals.norm(dim=-1), torch.ones(len(rows)), atol=1e-4)
