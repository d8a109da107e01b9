"""objective:tracks, the loss on 2D point tracks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from hoigs.core.errors import ClipError, PluginError, SpecError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.compose import compose_objectives
from hoigs.core.model.entity import Entity
from hoigs.core.model.objective import Objective, TrainingMoment, Weighted
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.spec.train_schema import LossSpec
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.objectives.tracks import Tracks
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.testing.material import HEIGHT, OBJECT, WIDTH, tiny_clip
from hoigs.training.objective import Extras, JointObjective

SIZE = (160, 128)  # of the pictures: splats of several pixels hide each other's places
SPEED = (0.35, -0.1, 0.05)  # of the truth, metres a clip


class Slides(DeformationModel):
    """Everything moves alike."""

    input_space = "world"

    def __init__(self, speed: tuple[float, float, float]) -> None:
        super().__init__()
        self.speed = nn.Parameter(torch.tensor(speed))

    def forward(self, canonical, moment, residual=None):
        return canonical.replace(means=canonical.means + self.speed * moment.time)


def larger() -> Clip:
    clip = tiny_clip()
    return replace(clip, cameras=[camera.resized(*SIZE) for camera in clip.cameras])


def plate(speed: tuple[float, float, float]) -> SceneModel:
    """An opaque plate of small Gaussians, facing the camera."""
    x, y = torch.meshgrid(torch.linspace(-0.6, 0.6, 25), torch.linspace(-0.5, 0.5, 21))
    points = torch.stack((x, y, torch.full_like(x, 3.0)), -1).reshape(-1, 3)
    plate = Gaussians.from_points(points, opacity=0.95, scales=torch.full((len(points),), 0.04))
    return SceneModel(
        {OBJECT: Entity(plate, Slides(speed), kind="object")}, rasterizer=TorchRasterizer()
    )


@pytest.fixture
def tracked(tmp_path: Path) -> Path:
    """Where points of the true plate are in every frame, at twice the clip's size."""
    clip, points = tiny_clip(), torch.tensor([[-0.3, -0.2, 3.0], [0.2, 0.25, 3.0], [0.0, 0.0, 3.0]])
    pixels = [
        camera.project(points + torch.tensor(SPEED) * moment.time)[0]
        for camera, moment in zip(clip.cameras, clip.moments, strict=True)
    ]
    visible = np.ones((len(clip), len(points)), bool)
    visible[3, 0] = False
    xy = 2 * torch.stack(pixels).numpy()
    xy[3, 0] = np.nan
    np.savez(tmp_path / "t.npz", xy=xy, visible=visible, size=np.array([2 * WIDTH, 2 * HEIGHT]))
    return tmp_path / "t.npz"


def losses(model: SceneModel, objective: Objective, position: int, seed: int = 0):
    frame, camera = tiny_clip().frame(position), larger().cameras[position]
    state = model(frame.moment)
    generator = torch.Generator().manual_seed(seed)
    at = TrainingMoment(model, frame, camera, state, generator)
    channels = objective.channels(at)
    drawn = model.draw(state.joined(), camera, RenderRequest(features=channels))
    return objective.terms(at, drawn, drawn.features)


def test_the_truth_costs_little_and_is_found(tracked: Path) -> None:
    objective = Tracks(path=tracked, clip=larger())
    model = plate(SPEED)
    # the nearer ones of the splats in a pixel hide the others: 0.05 m
    assert all(losses(model, objective, p)["reprojection"] < 0.02 for p in (0, 4, 8))
    model = plate((0.0, 0.0, 0.05))
    assert losses(model, objective, 0)["reprojection"] > 0.04
    speed = model.entity(OBJECT).deformation.speed
    optimizer = torch.optim.Adam([speed], 0.05)
    for step in range(25):
        optimizer.zero_grad()
        loss = losses(model, objective, (0, 8)[step % 2], step)["reprojection"]
        loss.backward()
        optimizer.step()
    assert (speed.detach() - torch.tensor(SPEED))[:2].abs().max() < 0.06


def test_a_spec_names_it_and_weighs_it(tracked: Path) -> None:
    settings = [f"objectives.points.{k}" for k in ("use=objective:tracks", "weight=0.5")]
    settings.append(f"objectives.points.path={tracked}")
    spec = Spec.load("hoigs", overrides=settings)
    assert Spec.parse(spec.dump()) == spec
    assert spec.hash() != Spec.load("hoigs").hash()
    assert spec.model_hash() == Spec.load("hoigs").model_hash()
    (found,) = compose_objectives(spec, tiny_clip())
    assert (found.name, found.weight) == ("points", 0.5)
    model, frame = plate((0.0, 0.0, 0.0)), tiny_clip().frame(0)
    loss = LossSpec(ssim="torch", background="black")

    def total(*objectives: Weighted):
        objective = JointObjective(model, loss, "none", Extras(objectives=objectives))
        return objective(frame, frame.camera, torch.Generator().manual_seed(1))

    with_it, without = total(found), total()
    term = with_it.terms["objective/points/reprojection"]
    assert with_it.weights["objective/points/reprojection"] == 0.5
    torch.testing.assert_close(with_it.composite.color, without.composite.color)
    expected = without.total + 0.5 * term
    torch.testing.assert_close(with_it.total, expected, rtol=1e-4, atol=1e-5)
    nothing = Spec.load("hoigs", overrides=[*settings, "objectives.points.weight=0"])
    assert compose_objectives(nothing, tiny_clip()) == ()


def test_what_is_wrong_is_named(tracked: Path, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"objectives\.x\.use.*objective:track.*objective:tracks"):
        Spec.load("hoigs", overrides=["objectives.x.use=objective:track"])
    with pytest.raises(SpecError, match=r"objectives\.x\.use.*density:none.*no objective"):
        Spec.load("hoigs", overrides=["objectives.x.use=density:none"])
    np.savez(tmp_path / "short.npz", xy=np.zeros((3, 2, 2)), visible=np.ones((3, 2)), size=[4, 4])
    with pytest.raises(ClipError, match=r"short\.npz.* 3 frames.* 9"):
        Tracks(path=tmp_path / "short.npz", clip=tiny_clip())
    np.savez(tmp_path / "odd.npz", xy=np.zeros((9, 2, 3)), visible=np.ones((9, 2)), size=[4, 4])
    with pytest.raises(ClipError, match=r"odd\.npz.*\[9, 2, 3\]"):
        Tracks(path=tmp_path / "odd.npz", clip=tiny_clip())
    with pytest.raises(ClipError, match=r"absent\.npz"):
        Tracks(path=tmp_path / "absent.npz", clip=tiny_clip())


def test_a_wrong_plugin_is_named() -> None:
    class TwoRows(Objective):
        def channels(self, at):
            return torch.zeros(2, 1)

        def terms(self, at, drawn, channels):
            return {"map": drawn.alpha}

    model, frame = plate((0.0, 0.0, 0.0)), tiny_clip().frame(0)
    at = TrainingMoment(model, frame, frame.camera, model(frame.moment), torch.Generator())
    wrong = Weighted("mine", TwoRows(), 1.0)
    with pytest.raises(PluginError, match=r"mine.*TwoRows.*\[2, 1\].*525"):
        wrong.channels(at)
    with pytest.raises(PluginError, match=r"mine.*TwoRows.*map.*\[16, 20\]"):
        wrong.terms(at, model.draw(at.state.joined(), frame.camera), None)
