"""The human's terms beyond its own drawing: the composite's crop, L_face, LPIPS's network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from portrait import POINTS, SIZE, portrait
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.maths.rotations import axis_angle_to_matrices, kabsch
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.spec.train_schema import LossSpec
from hoigs.core.values.gaussians import Gaussians
from hoigs.metrics.image_loss import image_loss
from hoigs.metrics.lpips import STACKS
from hoigs.plugins.deformation.static import Static
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.face import face_loss, lookup, unwrap_faces, visible
from hoigs.training.losses import crop_around
from hoigs.training.objective import Extras, JointObjective
from hoigs.training.session import lpips_term


def test_the_face_looks_ahead_and_is_on_the_head():
    person = portrait()[0].entity("human")
    rows, normals = person.deformation.face_points()
    assert 40 < len(rows) < 0.1 * POINTS
    assert (person.deformation.point_parts()[rows] == 3).all()
    assert (normals[:, 2] > 0.3).all()
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(rows)))
    face, head = person.means[rows], person.means[person.deformation.point_parts() == 3]
    assert face[:, 2].mean() > head[:, 2].mean() + 0.03  # the front
    assert face[:, 1].max() < head[:, 1].max() - 0.02  # not the crown
    assert face[:, 2].max() == head[:, 2].max()  # the nose


def test_unwrapped_texture_is_the_faces_own_colour():
    texture = unwrap_faces(portrait()[0], portrait()[1])["human"]
    person = portrait()[0].entity("human")
    rows = person.deformation.face_points()[0]
    nearest = torch.cdist(texture.points, person.means[rows]).argmin(1)
    truth = person.canonical.colors[rows[nearest]]
    error = (texture.colors - truth).abs().mean()
    assert len(texture.points) > 0.7 * len(rows)
    assert error < 0.5 * (texture.colors - truth[torch.randperm(len(truth))]).abs().mean()


def loss_at(shift: Tensor, position: int = 2) -> Tensor:
    """L_face of a frame when the whole person stands `shift` beside the truth."""
    frame, person = portrait()[1][position], portrait()[0].entity("human")
    posed = person(frame.moment)
    posed = posed.replace(means=posed.means + shift)
    texture = unwrap_faces(portrait()[0], portrait()[1])["human"]
    found = face_loss(texture, person, posed, frame.camera, frame.rgb, visible(frame, "human"))
    assert found is not None
    return found


def test_face_term_is_least_where_the_face_is_and_pulls_there():
    here = float(loss_at(torch.zeros(3)).detach())
    for shift in ((0.012, 0, 0), (-0.012, 0, 0), (0, 0.012, 0), (0, -0.012, 0)):
        leaf = torch.tensor(shift, requires_grad=True)
        value = loss_at(leaf)
        assert float(value.detach()) > 1.15 * here
        value.backward()
        assert float((leaf.grad * leaf.detach()).sum()) > 0  # downhill is back


def test_face_term_equals_its_formula():
    """Mean |I(pi(p)) - c| over the seen points, with a bilinear lookup written out in float64."""
    frame, person = portrait()[1][3], portrait()[0].entity("human")
    texture = unwrap_faces(portrait()[0], portrait()[1])["human"]
    posed = person(frame.moment)
    mask = visible(frame, "human")
    found = face_loss(texture, person, posed, frame.camera, frame.rgb, mask)
    rows, normals = person.deformation.face_points()
    turn = axis_angle_to_matrices(frame.moment.poses["human"].body[14]).double()
    image, view = frame.rgb.double(), frame.camera.world_to_camera.double()
    eye = -view[:3, :3].T @ view[:3, 3]
    total, count = 0.0, 0
    for row, normal in zip(rows.tolist(), normals.double(), strict=True):
        p = posed.means[row].detach().double()
        inside_camera = view[:3, :3] @ p + view[:3, 3]
        x, y = (
            float(inside_camera[k] / inside_camera[2] * frame.camera.K[k, k] + frame.camera.K[k, 2])
            for k in (0, 1)
        )
        towards = torch.nn.functional.normalize(eye - p, dim=0)
        if float((turn @ normal) @ towards) <= 0.4 or not mask[int(y), int(x)]:
            continue
        u, v = x - 0.5, y - 0.5
        i, j = int(np.floor(u)), int(np.floor(v))
        fx, fy = u - i, v - j
        color = (
            (1 - fx) * (1 - fy) * image[j, i] + fx * (1 - fy) * image[j, i + 1]
            + (1 - fx) * fy * image[j + 1, i] + fx * fy * image[j + 1, i + 1]
        )  # fmt: skip
        near = (texture.points - person.means[row]).norm(dim=1).argmin()
        total += float((color - texture.colors[near].double()).abs().mean())
        count += 1
    assert count > 20
    assert float(found.detach()) == pytest.approx(
        total / count, rel=0.02
    )  # a point may sit on the edge


def test_kabsch_and_lookup():
    torch.manual_seed(0)
    points, turn = torch.randn(20, 3), axis_angle_to_matrices(torch.tensor([0.4, -1.2, 2.0]))
    moved = points @ turn.mT + torch.tensor([1.0, 2, 3])
    torch.testing.assert_close(kabsch(points, moved), turn)
    flat = points * torch.tensor([1.0, 1.0, 0.0])  # a plane could be mirrored: it must not be
    torch.testing.assert_close(kabsch(flat, flat @ turn.mT), turn)
    image = torch.rand(5, 7, 3)
    centers = torch.tensor([[0.5, 0.5], [6.5, 4.5], [3.5, 2.5]])
    expected = torch.stack((image[0, 0], image[4, 6], image[2, 3]))
    torch.testing.assert_close(lookup(image, centers), expected)


def terms(**settings) -> dict[str, Tensor]:
    spec = LossSpec(background="black", ssim="torch", **settings)
    faces = unwrap_faces(portrait()[0], portrait()[1]) if spec.face > 0 else None
    objective = JointObjective(portrait()[0], spec, "none", Extras(faces=faces))
    frame = portrait()[1][1]
    return objective(frame, frame.camera, torch.Generator().manual_seed(0)).terms


def test_which_image_of_the_human_is_compared():
    alone, composite, both = (terms(human_image=kind) for kind in ("alone", "composite", "both"))
    of = lambda found: {n for n in found if n.startswith("human")}  # noqa: E731
    assert of(alone) == {"human/human"}
    assert of(composite) == {"human/human/composite"}
    assert of(both) == {"human/human", "human/human/composite"}
    torch.testing.assert_close(both["human/human"], alone["human/human"])
    frame = portrait()[1][1]
    crop = crop_around(frame, "human")
    with torch.no_grad():
        drawn = portrait()[0].render(frame.moment, frame.camera).color
    part = crop.cut(drawn)
    assert torch.equal(crop.cut(frame.rgb), crop.image)
    expected = image_loss(part, crop.image, 0.2, "torch")
    torch.testing.assert_close(composite["human/human/composite"].detach(), expected)


def test_pixels_that_show_nothing_are_left_out_of_the_composite():
    frame = portrait()[1][1]
    ignored = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    ignored[15:30, 15:33] = True
    image = frame.image.masked_fill(ignored[..., None], 0)
    spec = LossSpec(human_image="composite", lambda_dssim=0.0)
    found = {}
    for name, hidden in {"told": ignored, "not told": None}.items():
        shown = replace(frame, image=image, ignored=hidden)
        objective = JointObjective(portrait()[0], spec, "none")
        result = objective(shown, frame.camera, torch.Generator())
        found[name] = float(result.terms["human/human/composite"].detach())
    assert found["told"] < 0.01
    assert found["not told"] > 0.05


def test_face_term_joins_the_objective_with_its_weight():
    plain, half = terms(), terms(face=0.5)
    assert "human/human/face" not in plain
    whole = terms(face=1.0)["human/human/face"]
    torch.testing.assert_close(half["human/human/face"], 0.5 * whole)
    portrait()[0].zero_grad()
    whole.backward()
    moved = portrait()[0].entity("human").deformation
    assert moved.refinement.pose.grad.abs().max() > 0
    assert moved.log_alpha.grad.abs() > 0
    portrait()[0].zero_grad()


def test_a_model_without_a_face_is_told():
    scene = SceneModel(
        {"thing": Entity(Gaussians.from_points(torch.randn(9, 3)), Static(), kind="human")},
        rasterizer=TorchRasterizer(),
    )
    with pytest.raises(ValueError, match="no human of this model has one"):
        unwrap_faces(scene, portrait()[1])


def test_lpips_net_is_the_one_asked_for(tmp_path: Path):
    arrays: dict[str, np.ndarray] = {}
    channels = (3, 64, 192, 384, 256, 256)
    sizes = (11, 5, 3, 3, 3)
    for i in range(len(STACKS["alex"].convs)):
        shape = (channels[i + 1], channels[i], sizes[i], sizes[i])
        arrays[f"conv{i}_w"] = np.full(shape, 0.01, np.float16)
        arrays[f"conv{i}_b"] = np.zeros(channels[i + 1], np.float16)
        arrays[f"lin{i}"] = np.ones(channels[i + 1], np.float16)
    file = tmp_path / "alex.npz"
    np.savez(file, **arrays)
    spec = lambda net: Spec.load(  # noqa: E731
        "static", overrides=["train.loss.lpips=0.2", f"train.loss.lpips_net={net}"]
    )
    assert lpips_term(spec("alex"), file, "cpu").net == "alex"
    assert lpips_term(spec("null"), file, "cpu").net == "alex"
    with pytest.raises(HoigsError, match=r"lpips_net is vgg, but .* is alex"):
        lpips_term(spec("vgg"), file, "cpu")
