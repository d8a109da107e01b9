"""Objects that move rigidly, fitted from pictures; deformations that change size in training."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from moving_clip import Thing, backdrop, clip_of, scripted

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.training.trainer import Trainer

FRAMES = 17
ADAPTIVE = "keyframes: adaptive, adaptive: {begin: 0.1, end: 0.8, every: 8}"

TEXT = """
name: test
rasterizer: {use: "rasterizer:warp"}
model:
  scene: {deformation: {use: "deformation:static"}, points: 300}
  object:
    deformation: {use: "deformation:rigid-spline"}
    points: 80
    opacity: 0.9
train:
  preview_every: 0
  warmup: {motion: 0}
  rates: {means: 0, sh: 0, scale: 0, rotation: 0, opacity: 0, keyframes: 4e-3,
          keyframes_final: 2e-4, keyframe_rotation: 3e-3}
"""


def spec_of(deformation: str, steps: int) -> Spec:
    text = TEXT.replace('use: "deformation:rigid-spline"', deformation)
    return Spec.parse(text.replace("train:\n", f"train:\n  steps: {steps}\n"))


@pytest.fixture(scope="module")
def thing() -> Thing:
    return scripted("held", FRAMES)


@pytest.fixture(scope="module")
def clip(thing: Thing) -> Clip:
    """Its track is off by centimetres and degrees, smoothly."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.nn.functional.interpolate(
        torch.randn(1, 6, 5, generator=generator), FRAMES, mode="linear", align_corners=True
    )[0].T
    true = thing.track()
    turned = true.rotations @ axis_angle_to_matrices(0.05 * noise[:, :3])
    wrong = replace(true, rotations=turned, translations=true.translations + 0.03 * noise[:, 3:])
    return clip_of({"object": thing}, frames=FRAMES, size=48, tracks={"object": wrong})


def prepared(spec: Spec, clip: Clip, thing: Thing) -> tuple[SceneModel, Trainer]:
    """The model with the right shapes and colours: only the motion is to be found."""
    model = compose(spec, clip)
    for name, shape in (("object", thing.shape), ("scene", backdrop())):
        for field, value in shape.tensors().items():
            getattr(model.entity(name), field).data.copy_(value)
    return model, Trainer(model, clip, spec.train, density=compose_density(spec, clip))


@torch.no_grad()
def pixels_off(model: SceneModel, clip: Clip, true: ObjectTrack) -> float:
    """Mean distance on the screen from where the object is, over points and frames."""
    camera, off = clip.cameras[0], []
    for frame, moment in enumerate(clip.moments):
        place = true.points @ true.rotations[frame].mT + true.translations[frame]
        found = model.entity("object")(moment).means
        pixels = [camera.to_camera(x) @ camera.K.T for x in (place, found)]
        a, b = (p[:, :2] / p[:, 2:] for p in pixels)
        off.append((a - b).norm(dim=-1).mean())
    return float(torch.stack(off).mean())


@pytest.mark.parametrize(
    "deformation",
    [
        'use: "deformation:rigid-spline", keyframe_step: 2',
        f'use: "deformation:rigid-spline", keyframe_step: 2, {ADAPTIVE}',
    ],
    ids=["uniform", "adaptive"],
)
def test_a_rigid_object_is_found_to_a_fraction_of_a_pixel(deformation, clip, thing):
    model, trainer = prepared(spec_of(deformation, 100), clip, thing)
    before = pixels_off(model, clip, thing.track())
    trainer.train()
    after = pixels_off(model, clip, thing.track())
    assert before > 0.9 and after < 0.7 * before
    assert not trainer.guard.skipped


@pytest.mark.parametrize("use", ["rigid-spline", "chs"])
def test_a_resumed_run_equals_an_unbroken_one_though_knots_move(use, clip, thing):
    spec = spec_of(f'use: "deformation:{use}", {ADAPTIVE}', 26)
    whole, trainer = prepared(spec, clip, thing)
    start = len(whole.entity("object").deformation.knots)
    trainer.train()
    first, broken = prepared(spec, clip, thing)
    sizes = set()
    while broken.step < 18:
        broken._step()
        sizes.add(len(first.entity("object").deformation.knots))
    saved = broken.checkpoint()
    second, resumed = prepared(spec, clip, thing)
    resumed.resume(saved)
    resumed.train()
    assert len(sizes | {start}) > 1  # knots did come or go before the break
    mine, theirs = second.state_dict(), whole.state_dict()
    assert mine.keys() == theirs.keys()
    for name, value in theirs.items():
        torch.testing.assert_close(mine[name], value, atol=1e-5, rtol=1e-4, msg=name)
    # the optimizer's moments have the shapes of what they belong to
    for name, parameter in resumed.optimizer.names.items():
        state = resumed.optimizer.adam.state.get(parameter, {})
        assert "exp_avg" not in state or state["exp_avg"].shape == parameter.shape, name


def test_parameters_that_are_views_are_made_dense_for_adam():
    """A view's elements lie apart in memory, where fused Adam does not look for them."""
    from hoigs.core.spec.train_schema import RatesSpec, WarmupSpec
    from hoigs.training.optimizer import GroupedAdam

    thing = scripted("pushed", 3)
    spec = spec_of('use: "deformation:rigid-spline"', 1)
    model = compose(spec, clip_of({"object": thing}, frames=3, size=16))
    entity = model.entity("object")
    entity.deformation.keyframe_quats.data = torch.ones(2, 9)[:, :4]
    optimizer = GroupedAdam(model, RatesSpec(keyframe_rotation=0.5), WarmupSpec(motion=0), 1.0)
    optimizer.set_progress(0.0)
    entity.deformation.keyframe_quats.grad = torch.ones(2, 4)
    optimizer.step()
    torch.testing.assert_close(entity.deformation.keyframe_quats.data, torch.full((2, 4), 0.5))
