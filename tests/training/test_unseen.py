"""Gaussians that no training frame shows take their values from their neighbours."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_clip import small_clip

from hoigs.core.interfaces.body import HEAD_PART
from hoigs.core.interfaces.deformation import Template
from hoigs.core.model.compose import compose
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.spec.train_schema import TrainSpec
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.rasterizers.warp import WarpRasterizer
from hoigs.synthesis import SceneConfig, builtin_clip
from hoigs.training import unseen as filling
from hoigs.training.unseen import (
    blending_weights,
    confidence,
    fill_unseen,
    opposite_points,
    seen_weights,
    spread,
)


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


def test_a_small_one_is_known_from_its_few_pixels_and_a_hidden_one_is_not() -> None:
    shown = torch.tensor([10.0, 0.2, 0.05, 0.0, 0.0])
    seen = confidence(shown, torch.tensor([12.0, 0.3, 12.0, 12.0, 0.0]))
    assert seen is not None
    assert (seen[:2] > 0.9).all() and (seen[2:] < 0.1).all()
    assert confidence(torch.zeros(3), torch.ones(3)) is None


def test_what_is_behind_a_wall_is_hidden_and_what_is_transparent_before_it_is_seen() -> None:
    u = torch.linspace(-1.5, 1.5, 60)
    x, y = torch.meshgrid(u, u, indexing="xy")
    wall = torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3)
    others = torch.tensor([[0.1, 0.0, -1.0], [0.1, 0.0, 0.5], [99.0, 0.0, 0.5]])
    parts = [
        Gaussians.from_points(points, torch.zeros_like(points), scales=0.05, opacity=opacity)
        for points, opacity in ((wall, 0.99), (others, 0.001))
    ]
    entities = {"object": Entity(Gaussians.cat(parts), Static(), kind="object")}
    model = SceneModel(entities, rasterizer=WarpRasterizer(), low_pass=0.1, antialiased=True)
    shown, alone = seen_weights(model, small_clip())["object"]
    before, behind, aside = shown[-3:] / alone[-3:].clamp_min(1e-9)
    assert 0.7 < before < 1.01 and behind < 0.05 and aside == 0
    seen = confidence(shown, alone)
    assert seen is not None and seen[-3] > 0.9 and (seen[-2:] < 0.2).all()


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
    total = blending_weights(model, model(moment).joined().detach(), camera).sum()
    covered = model.render(moment, camera).alpha.sum()
    torch.testing.assert_close(total, covered.detach(), rtol=1e-3, atol=0)
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


def test_people_are_filled_in_by_their_own_steps_and_scenes_by_all(monkeypatch) -> None:
    calls = []

    def record(model, clip, **options) -> dict[str, torch.Tensor]:
        calls.append((step, options["shapes"], options["own"], options["scenes"]))
        return {"scene": torch.full((1,), float(step))}

    monkeypatch.setattr(filling, "fill_unseen", record)
    spec = TrainSpec(steps=30, fill_unseen=(0.5, 1.0))
    made = filling.Filling(spec, settled=16)
    for step in range(1, 31):
        made.after(step, None, None)
    assert calls == [
        (8, True, True, False), (15, True, False, True),
        (16, False, True, False), (30, False, False, True),
    ]  # fmt: skip
    assert float(made.hidden["scene"]) == 30
    calls.clear()
    made = filling.Filling(spec, settled=30)
    for step in range(1, 31):
        made.after(step, None, None)
    assert calls == [(15, True, True, True), (30, False, True, True)]
