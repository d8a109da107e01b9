"""Two people and two things in one clip: each its own block, its own track, its own tokens."""

from __future__ import annotations

import torch
from moving_clip import clip_of, scripted, speckled_box

from hoigs.core.model.compose import compose, compose_density
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import BodyTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.deformation.articulated import Articulated
from hoigs.plugins.deformation.chs import CubicHermite
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.training.trainer import Trainer

FRAMES = 4
TEXT = """
name: many
interaction: {use: "interaction:cross-attention"}
model:
  scene: {deformation: {use: "deformation:static"}, points: 100}
  human:
    deformation: {use: "deformation:hexplane-skinning"}
    features: {use: "features:body-parts"}
    points: 150
  bob:
    deformation: {use: "deformation:hexplane-skinning"}
    features: {use: "features:body-parts"}
    points: 90
  object:
    deformation: {use: "deformation:chs"}
    features: {use: "features:spline-motion", embedding: shared}
    points: 30
  laptop:
    deformation: {use: "deformation:articulated"}
    features: {use: "features:spline-motion", embedding: shared}
    points: 40
train: {steps: 4, preview_every: 0, warmup: {interaction: 0, motion: 0, poses: 0}}
"""


def people(body: AnnyBody) -> tuple[dict[str, BodyTrack], dict[str, list[Gaussians]]]:
    """Ann on the left, Bob on the right, both standing, and what they look like."""
    tracks, drawn = {}, {}
    for name, x in (("ann", -0.5), ("bob", 0.5)):
        pose = BodyPose.zeros(FRAMES, betas=body.num_betas)
        pose = pose.replace(transl=torch.tensor([x, 1.0, 0.0]).repeat(FRAMES, 1))
        tracks[name] = BodyTrack("body:anny", pose)
        with torch.no_grad():
            vertices = body(pose.frame(0)).vertices[::40]
        color = torch.tensor([[0.9, 0.3, 0.2]]).expand(len(vertices), 3)
        drawn[name] = [Gaussians.from_points(vertices, color, scales=0.05, opacity=0.9)] * FRAMES
    return tracks, drawn


def test_two_people_and_two_things_compose_train_and_render():
    tracks, drawn = people(AnnyBody())
    things = {
        "ball": scripted("held", FRAMES, speckled_box(40, 0.3)),
        "laptop": scripted("pushed", FRAMES, speckled_box(40, 0.4, seed=5)),
    }
    clip = clip_of(things, frames=FRAMES, size=40, bodies=tracks, drawn_bodies=drawn)
    spec = Spec.parse(TEXT)
    model = compose(spec, clip)
    assert model.count() == {"scene": 100, "ball": 30, "laptop": 40, "ann": 150, "bob": 90}
    assert isinstance(model.entity("ball").deformation, CubicHermite)
    assert isinstance(model.entity("laptop").deformation, Articulated)
    assert isinstance(model.entity("laptop").deformation, RigidSpline)
    # each on its own track
    for name, thing in things.items():
        here = model.entity(name)(clip.moments[2]).means.mean(0)
        assert (here - thing.translations[2]).norm() < 0.1
    state = model(clip.moments[1])
    assert set(state.tokens) == set(state.residuals) == {"ann", "bob", "ball", "laptop"}
    before = {n: p.detach().clone() for n, p in model.named_parameters()}
    trainer = Trainer(model, clip, spec.train, density=compose_density(spec, clip))
    seen: set[str] = set()
    trainer.train(lambda report: seen.update(report.losses))
    assert {"human/ann", "human/bob", "object/ball", "object/laptop", "scene"} <= seen
    assert not trainer.guard.skipped
    for name in clip.kinds:
        moved = [
            n
            for n, p in model.named_parameters()
            if n.startswith(f"entities.{name}.") and not torch.equal(p, before[n])
        ]
        assert any(".deformation." in n for n in moved), name
    camera = clip.cameras[0]
    with torch.no_grad():
        whole = model.render(clip.moments[3], camera)
        assert torch.isfinite(whole.color).all()
        for name in clip.kinds:
            alone = model.render(clip.moments[3], camera, only=[name])
            assert alone.alpha.max() > 0.05, name
    twin = compose(spec, clip)
    twin.load_state_dict(model.state_dict())
    with torch.no_grad():
        again = twin.render(clip.moments[3], camera).color
    torch.testing.assert_close(again, whole.color, atol=1e-6, rtol=0)
