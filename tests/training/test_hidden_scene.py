"""What people and objects hide in every frame continues the scene around it."""

from __future__ import annotations

import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.deformation.static import Static
from hoigs.training.unseen import MOST, OPAQUE, fill_hidden

CAMERA = [torch.zeros(3)]


def wall(side: int = 40) -> tuple[Entity, torch.Tensor]:
    """A wall, dark on the left and bright on the right, with garish, transparent spikes in its
    middle; and which of its Gaussians these are."""
    u = torch.linspace(-1, 1, side)
    x, y = torch.meshgrid(u, u, indexing="xy")
    points = torch.stack((x, y, torch.full_like(x, 3.0)), -1).reshape(-1, 3)
    gaussians = Gaussians.from_points(points, (0.5 + 0.3 * points[:, :1]).repeat(1, 3), sh_degree=1)
    hidden = (points[:, :2].abs() < 0.5).all(1)
    sh, logits, scales = (
        v.clone() for v in (gaussians.sh, gaussians.opacity_logits, gaussians.log_scales)
    )
    sh[hidden], logits[hidden], scales[hidden, 0] = 5.0, -4.0, 0.0
    spoilt = gaussians.replace(sh=sh, opacity_logits=logits, log_scales=scales)
    return Entity(spoilt, Static(), kind="scene"), hidden


def test_the_hidden_part_is_opaque_and_between_its_surroundings() -> None:
    scene, hidden = wall()
    before = {name: value.detach().clone() for name, value in scene.named_parameters()}
    alone = torch.ones(len(scene))
    fill_hidden(scene, torch.where(hidden, 0.01, 1.0), alone, CAMERA)
    colors = scene.canonical.colors[hidden]
    assert (colors - (0.5 + 0.3 * scene.means[hidden, :1])).abs().max() < 0.02
    assert (scene.sh[hidden, 1:] == 0).all()
    deep = (scene.means[:, :2].abs() < 0.4).all(1)
    assert torch.allclose(scene.canonical.opacities[deep], torch.tensor(OPAQUE))
    assert (scene.canonical.scales[deep] < 0.1).all()
    rim = hidden & (scene.means[:, :2].abs() > 0.47).any(1)
    torch.testing.assert_close(scene.log_scales[rim], before["log_scales"][rim])
    for name, value in before.items():
        torch.testing.assert_close(scene.get_parameter(name)[~hidden], value[~hidden])
    torch.testing.assert_close(scene.means, before["means"])


def test_the_hidden_part_takes_the_colours_of_the_clips_own_points() -> None:
    scene, hidden = wall()
    red = torch.tensor([0.9, 0.1, 0.1]).expand(len(scene), 3)
    weights = torch.where(hidden, 0.01, 1.0), torch.ones(len(scene))
    before = scene.canonical.colors.detach().clone()
    fill_hidden(scene, *weights, CAMERA, points=(scene.means.detach() + 0.001, red))
    torch.testing.assert_close(scene.canonical.colors[hidden], red[hidden])
    torch.testing.assert_close(scene.canonical.colors[~hidden], before[~hidden])


def test_one_that_stands_alone_before_the_others_stays_off_what_is_seen() -> None:
    scene, hidden = wall()
    alone = Gaussians.from_points(torch.tensor([[0.1, 0.0, 1.5]]), torch.zeros(1, 3), sh_degree=1)
    joined = Gaussians.cat([scene.canonical.detach(), alone])
    scene = Entity(joined, Static(), kind="scene")
    hidden = torch.cat((hidden, torch.tensor([True])))
    fill_hidden(scene, torch.where(hidden, 0.01, 1.0), torch.ones(len(scene)), CAMERA)
    # the wall is seen from x = 0.5 at depth 3, which is 0.25 here; its neighbours are 1.5 away
    assert 0.05 < float(scene.canonical.scales[-1].detach().amax()) < 0.09


def test_what_some_frame_shows_stays_and_so_does_what_none_could() -> None:
    scene, hidden = wall()
    before = scene.sh.detach().clone()
    fill_hidden(scene, torch.where(hidden, 0.4, 1.0), torch.ones(len(scene)), CAMERA)
    fill_hidden(scene, torch.where(hidden, 0.0, 1.0), torch.where(hidden, 0.0, 1.0), CAMERA)
    fill_hidden(scene, torch.zeros(len(scene)), torch.zeros(len(scene)), CAMERA)
    fill_hidden(scene, torch.zeros(len(scene)), torch.ones(len(scene)), CAMERA)  # nothing known
    torch.testing.assert_close(scene.sh.detach(), before)


def test_a_large_part_is_solved_at_some_of_its_points() -> None:
    scene, hidden = wall(side=2 * int(MOST**0.5) + 100)
    assert hidden.sum() > MOST
    fill_hidden(scene, torch.where(hidden, 0.01, 1.0), torch.ones(len(scene)), CAMERA)
    colors = scene.canonical.colors[hidden]
    assert (colors - (0.5 + 0.3 * scene.means[hidden, :1])).abs().max() < 0.05
