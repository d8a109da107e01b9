"""Baselines with a human, and static and dynamic sets: native settings, and that each learns."""

from __future__ import annotations

import pytest
import torch
from matched import matched

from hoigs.core.model.compose import compose, compose_density
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.metrics.psnr import psnr
from hoigs.training.trainer import Trainer

STEPS = 100
AVATAR = "model.human.deformation"
TINY = (f"{AVATAR}.resolution=24", f"{AVATAR}.channels=8", f"{AVATAR}.width=32")

# how each is made small enough for a test; what it is stays
SMALL: dict[str, tuple[str, ...]] = {
    "exavatar": TINY,
    "hugs": TINY,
    "neuman-gs": TINY,
    "hosnerf-gs": (*TINY, "model.object.points=100"),
    "hold-gs": ("model.object.points=100",),
    "d2nerf-gs": ("model.scene.deformation.width=40", "model.scene.deformation.elastic_points=32"),
}
WITH_HUMAN = [name for name in SMALL if name != "d2nerf-gs"]


@torch.no_grad()
def score(model: SceneModel, clip: Clip) -> dict[str, float]:
    """Mean PSNR, dB, over the training frames: of all, and within the human's mask."""
    found: dict[str, list[float]] = {"all": [], "human": []}
    for position in clip.split["train"]:
        frame = clip[position]
        color = model.render(frame.moment, frame.camera).color.clamp(0, 1)
        found["all"].append(psnr(color, frame.rgb).item())
        mask = frame.masks["human"]
        if mask.any():
            found["human"].append(psnr(color[mask][None], frame.rgb[mask][None]).item())
    return {name: sum(values) / len(values) for name, values in found.items()}


@pytest.mark.parametrize("name", SMALL)
def test_it_learns(name, clip):
    small = ["model.scene.points=500", "model.scene.density.cap=600", *SMALL[name]]
    small += ["model.human.points=800"] if name in WITH_HUMAN else []
    spec = Spec.load(
        f"{name}@matched", overrides=[*small, f"train.steps={STEPS}", "train.preview_every=0"]
    )
    model = compose(spec, clip)
    trainer = Trainer(model, clip, spec.train, density=compose_density(spec, clip))
    model.eval()
    untrained = score(model, clip)
    trainer.train()
    trained = score(model.eval(), clip)
    assert trained["all"] > untrained["all"] + 6
    # the human starts as its own grey outline, already worth 14 dB
    assert trained["human"] > untrained["human"] + 0.6
    assert not trainer.guard.skipped


def native(name: str, clip: Clip, *overrides: str) -> tuple[Spec, SceneModel]:
    """A native spec, with few points only, and its model."""
    points = ["model.scene.points=50"]
    points += ["model.human.points=60"] if name in WITH_HUMAN else []
    spec = Spec.load(name, overrides=[*points, *overrides])
    return spec, compose(spec, clip)


def test_exavatar(clip):
    spec, model = native("exavatar", clip)
    human = model.entity("human").deformation
    assert model.names() == ["scene", "human"]  # no object: its pixels are scene
    assert human.planes.shape == (3, 128, 128, 32) and human.half_box == 1.0
    assert human.config.opacity == "one" and human.config.shape == "isotropic"
    assert human.config.skinning == "nearest" and human.candidates is not None
    assert human.posing is not None and len(human.canonical.geometry.linears) == 3
    assert not model.entity("human").means.requires_grad
    loss = spec.train.loss
    assert (loss.scene_loss, loss.human_image) == ("masked", "both")
    assert (loss.lpips, loss.lpips_net, loss.lambda_dssim) == (0.2, "vgg", 0.2)
    assert loss.regularizers["laplacian"] == 1e5 and human.config.hand_stiffness == 100
    assert Spec.load("exavatar").model["human"].points == 167_333  # 10475, subdivided twice
    assert (spec.train.rates.networks, spec.train.rates.pose) == (1e-3, 1e-4)


def test_hugs(clip):
    spec, model = native("hugs", clip)
    entity = model.entity("human")
    human = entity.deformation
    assert human.planes.shape == (3, 256, 256, 32)
    config = human.config
    assert (config.opacity, config.shape, config.skinning) == ("learned", "full", "learned")
    assert human.posing is None and human.canonical.rotation.out_features == 6
    assert entity.means.requires_grad and entity.sh.shape[1] == 1
    assert model.entity("scene").sh.shape[1] == 16
    assert not human.refinement.betas.requires_grad and human.refinement.pose.requires_grad
    density = compose_density(spec, clip)["human"]
    assert density.cap == 524_288 and spec.train.steps == 14_998
    assert density.window.refines(3600, 14_998) and not density.window.refines(2400, 14_998)
    assert not density.window.refines(3700, 14_998)  # every 600
    assert spec.train.loss.lpips == 1 and spec.train.loss.regularizers["skinning"] == 1000


def test_neuman_is_skinned_by_the_template(clip):
    spec, model = native("neuman-gs", clip)
    human = model.entity("human").deformation
    assert human.config.skinning == "nearest" and human.canonical.skinning is None
    assert model.names() == ["scene", "human"]
    assert spec.train.loss.scene_loss == "masked"


def test_hosnerf_hangs_the_object_on_the_skeleton(clip):
    _, model = native("hosnerf-gs", clip)
    thing = model.entity("object").deformation
    assert len(thing.bones) == len(thing.transitions) + 1 == len(thing.offset_quats)
    assert all(bone in ("human/left", "human/right", "world") for bone in thing.bones)
    assert any(bone != "world" for bone in thing.bones)  # it is carried at some time
    _, model = native("hosnerf-gs", clip, "model.object.deformation.transitions=[]")
    assert len(model.entity("object").deformation.bones) == 1


def test_hold_is_rigid(clip):
    _, model = native("hold-gs", clip)
    human, thing = model.entity("human").deformation, model.entity("object").deformation
    assert {n.partition(".")[0] for n, _ in human.named_parameters()} == {"log_alpha", "refinement"}
    assert {n.partition(".")[0] for n, _ in thing.named_parameters()} == {"corrections"}
    assert len(thing.corrections.turns) == clip.num_frames


def test_d2nerf_sorts_gaussians(clip):
    spec, model = native("d2nerf-gs", clip)
    field = model.entity("scene").deformation
    assert field.config.skew == 1.75
    field.set_progress(0.0)
    ramp = field.regularizers()["entropy"] / field.entropy()
    assert spec.train.loss.regularizers["entropy"] * ramp.item() == pytest.approx(1e-4)
    field.set_progress(1.0)
    torch.testing.assert_close(field.regularizers()["entropy"], field.entropy())


@pytest.mark.parametrize("name", SMALL)
def test_matched_differs_in_the_method_alone(name):
    ours, hoigs = matched(name)
    parts = [key for key in ("scene", "human", "object") if key in (ours.entities or ())]
    # what a method has no entity for is scene, which then gets its share of Gaussians
    points = sum(ours.model[key].points for key in parts)
    assert points == sum(hoigs.model[key].points for key in ("scene", "human", "object"))
    extra = ours.model["scene"].points - hoigs.model["scene"].points
    assert hoigs.model["scene"].density.settings["cap"] == "auto"
    cap = f"auto+{extra}" if extra else "auto"
    density = {**hoigs.model["scene"].density.settings, "cap": cap}
    assert ours.model["scene"].density.settings == density
    for key in parts[1:]:
        assert ours.model[key].density == hoigs.model[key].density
        assert ours.model[key].deformation.use == Spec.load(name).model[key].deformation.use
    assert ours.train.loss.regularizers == Spec.load(name).train.loss.regularizers
