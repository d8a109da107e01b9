"""Gaussians that no training frame shows take their values from their neighbours."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from hoigs.core.interfaces.body import HEAD_PART
from hoigs.core.interfaces.deformation import Template
from hoigs.core.model.compose import compose
from hoigs.core.spec.schema import Spec
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin_clip
from hoigs.training.unseen import fill_unseen
from hoigs.training.unseen.neighbours import opposite_points, spread
from hoigs.training.unseen.weights import blending_weights, confidence, seen_weights


def ring(count: int) -> torch.Tensor:
    angle = torch.arange(count) / count * 2 * torch.pi
    return torch.stack((angle.cos(), angle.sin(), torch.zeros(count)), -1)


def test_what_was_seen_stays_and_the_rest_lies_between() -> None:
    points, seen = ring(64), torch.zeros(64)
    seen[:16], seen[32:48] = 1.0, 1.0
    values = torch.full((64, 1), 99.0)
    values[:16], values[32:48] = 0.0, 1.0
    filled = spread(values, seen, points)
    assert torch.allclose(filled[seen > 0], values[seen > 0], atol=1e-2)
    assert filled.min() > -0.01 and filled.max() < 1.01
    assert (filled[16:32].diff(dim=0) > 0).all()  # from the one to the other


def test_a_side_has_the_colours_of_its_mirror_image() -> None:
    points = torch.cat((ring(40) + torch.tensor([2.0, 0, 0]), ring(40) - torch.tensor([2.0, 0, 0])))
    flipped = points * torch.tensor([-1.0, 1, 1])
    mirror = torch.cdist(flipped, points).argmin(-1)
    values = points.abs()  # the same on both sides
    values[40:] = 99.0
    seen = torch.cat((torch.ones(40), torch.zeros(40)))
    filled = spread(values, seen, points, mirror)
    assert (filled[40:] - points[40:].abs()).abs().mean() < 0.1


def tube(head: bool) -> Template:
    """A body part along y: half of its points face +z, the others -z."""
    angle, y = torch.rand(2, 3000, generator=torch.Generator().manual_seed(1))
    around = 2 * torch.pi * angle
    normals = torch.stack((around.cos(), torch.zeros_like(y), around.sin()), -1)
    points = 0.1 * normals + y[:, None] * torch.tensor([0.0, 1.0, 0.0])
    gaussians = Gaussians.from_points(points, torch.rand(3000, 3))
    parts = torch.full((3000,), HEAD_PART if head else HEAD_PART + 1)
    return Template(gaussians, points, normals, points * torch.tensor([-1.0, 1, 1]), parts)


def test_a_back_takes_the_stripes_of_the_front() -> None:
    template = tube(head=False)
    other = opposite_points(template)
    front, has = template.normals[:, 2] > 0, (other >= 0).all(1)
    assert has.float().mean() > 0.95 and (front[other[has]] != front[has, None]).all()
    stripes = (40 * template.points[:, 1:2]).sin()
    values, seen = torch.where(front[:, None], stripes, 99.0), front.float()
    smooth = spread(values, seen, template.points)
    patterned = spread(values, seen, template.points, opposite=other)
    deep = template.normals[:, 2] < -0.7
    assert (smooth - stripes)[deep].abs().mean() > 0.4
    assert (patterned - stripes)[deep].abs().mean() < 0.2
    torch.testing.assert_close(patterned[front], stripes[front], atol=1e-2, rtol=0)


def test_the_back_of_a_head_takes_no_face() -> None:
    assert (opposite_points(tube(head=True)) == -1).all()


def test_weight_outside_the_mask_is_no_sight_of_it() -> None:
    inside = torch.tensor([10.0, 10.0, 0.1, 0.0])
    seen = confidence(inside, torch.tensor([0.0, 9.9, 0.0, 0.0]))
    assert seen is not None
    assert seen[0] > 0.9 and (seen[1:] < 0.1).all()
    assert confidence(torch.zeros(3), torch.zeros(3)) is None


def test_colours_of_unseen_sides_change_and_images_of_training_frames_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path))
    clip = ClipFolderReader().read(builtin_clip(AnnyBody(), SceneConfig.tiny(held_out_views=0)))
    # thicker than they start: untrained thin ones show on outlines what is behind them
    sizes = ["model.human.points=3000", "model.human.thickness=0.2"]
    model = compose(Spec.load("hoigs", overrides=sizes), clip)
    human = model.entity("human")
    noise = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0))
    human.sh.data[:, 0] += noise - 0.5
    seen = confidence(*seen_weights(model, clip)["human"])
    moment, camera = clip[0].moment, clip[0].camera
    drawn = model(moment).joined().detach()
    maps = list(torch.rand(4, camera.height, camera.width))  # more than a picture has channels
    together = blending_weights(model, drawn, camera, maps)
    apart = [blending_weights(model, drawn, camera, [one])[0] for one in maps]
    torch.testing.assert_close(torch.stack(together), torch.stack(apart))
    assert seen is not None and 0.2 < (seen > 0.5).float().mean() < 0.8
    before = human.sh.detach().clone()[:, 0]
    frame = clip[clip.split["train"][0]]
    with torch.no_grad():
        image = model.eval().render(frame.moment, frame.camera, only=["human"]).color
        fill_unseen(model, clip)
        again = model.render(frame.moment, frame.camera, only=["human"]).color
    back = seen < 0.05
    assert human.sh[back, 0].std(0).mean() < 0.5 * before[back].std(0).mean()
    assert (human.sh[seen > 0.95, 0] - before[seen > 0.95]).abs().mean() < 0.02
    assert (again - image).abs().mean() < 0.1 * image.abs().mean()
