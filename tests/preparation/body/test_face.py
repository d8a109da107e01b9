"""The size of a person by that of the face."""

from __future__ import annotations

import math

import pytest
import torch
from test_body_fit import (
    FOCAL,
    FRAMES,
    HEIGHT,
    QUICK,
    WIDTH,
    body,
    camera,
    seen_by,
    truth,
)

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.preparation.body.face import BODIES, NOSE, SIDES, Faces, Size, faces_of
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.landmarks import Landmarks

K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def face_at(depth: float, yaw: float, larger: float = 1.0) -> torch.Tensor:
    """Landmarks of a face whose nose is that far off, turned about the vertical; radians."""
    places = {0: NOSE}
    for (left, right), (x, y, z) in SIDES.items():
        places |= {left: (x, y, z), right: (-x, y, z)}
    points = larger * torch.tensor(list(places.values()))
    turn = axis_angle_to_matrices(torch.tensor([0.0, yaw, 0.0])) @ torch.diag(
        torch.tensor([1.0, -1.0, -1.0])
    )
    cam = (points - points[0]) @ turn.mT + torch.tensor([0.1, -0.2, depth])
    image = torch.zeros(33, 3)
    image[list(places), :2] = (cam / cam[:, 2:] @ K.mT)[:, :2]
    image[list(places), 2] = 1
    return image


@pytest.mark.parametrize("yaw", [0.0, 0.5, -0.9])
def test_a_face_of_the_mean_size_is_as_far_off_as_it_is(yaw: float) -> None:
    faces = faces_of(torch.stack([face_at(0.5, yaw), face_at(2.0, yaw)]), K.expand(2, 3, 3))
    assert faces.noses.tolist() == pytest.approx([0.5, 2.0], rel=0.01)
    assert faces.eyes[0] == pytest.approx(FOCAL * 0.0888 / 0.5, rel=0.2)


def test_what_shows_no_face_gives_no_size() -> None:
    away, hidden, odd = face_at(1.0, math.pi), face_at(1.0, 0.0), face_at(1.0, 0.0)
    hidden[3, 2] = 0.1
    odd[[9, 10], 1] += 20
    faces = faces_of(torch.stack([away, hidden, odd]), K.expand(3, 3, 3))
    assert faces.noses.isnan().all()
    assert Size.by_face(1.0, torch.ones(3), faces) == Size()


def test_a_large_face_is_believed_the_less_the_smaller_it_is_in_the_image() -> None:
    noses = torch.full((9,), 1.1)
    near, far = (
        Size.by_face(1.0, torch.ones(9), Faces(noses, torch.full((9,), eyes))) for eyes in (80.0, 8)
    )
    assert 1.05 < near.mean < 1.08
    assert 1.0 < far.mean < 1.04
    assert near.spread < far.spread < BODIES
    odd = Faces(torch.full((9,), 1.6), torch.full((9,), 40.0))
    assert Size.by_face(1.0, torch.ones(9), odd) == Size()
    # what was found of a body that has that size already is the same
    again = Size.by_face(near.mean, torch.full((9,), near.mean), Faces(noses, torch.full((9,), 80)))
    assert again.mean == pytest.approx(near.mean, abs=1e-3)


def test_a_person_with_a_large_face_is_larger_and_farther_off() -> None:
    small, zoom = camera(), 1.5  # that the eyes are far enough apart
    large = small.resized(round(zoom * small.width), round(zoom * small.height))
    cameras, seen = [large] * FRAMES, seen_by([large] * FRAMES, truth())
    usual = fit_body(body(), Observations(seen, cameras), QUICK)
    assert usual.report["size"] == 1 and usual.report["size_spread"] == BODIES
    image = seen.image.clone()
    face = face_at(1.15 * float(usual.poses.transl[:, 2].mean()), 0.0)
    face[:, :2] *= zoom
    marks = [mark for mark in range(11) if mark not in (0, 7, 8) and face[mark, 2] > 0]
    # the nose is the body's own: move the face to it
    image[:, marks] = face[marks] + (seen.image[:, :1] - face[0]) * torch.tensor([1.0, 1, 0])
    larger = fit_body(body(), Observations(Landmarks(image, seen.world), cameras), QUICK)
    assert larger.report["size"] > 1.02
    farther = larger.poses.transl[:, 2] / usual.poses.transl[:, 2]
    assert farther.mean() == pytest.approx(larger.report["size"], abs=0.015)
