"""Recorded training steps: the plain path's values, gradients and trajectories, or a reason."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from emulated_graphs import emulate
from recorded_scene import (
    VARIANTS,
    at,
    compared,
    gradients,
    loss,
    recording,
    same_gradients,
    scene,
    weight_of,
)
from torch import Tensor

from hoigs.core.deformation import DeformationModel
from hoigs.core.entity import Entity
from hoigs.core.errors import HoigsError
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.scene import SceneModel
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.deformation.triplane_avatar import TriplaneAvatar
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.recorded import RecordedScene

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("variant", VARIANTS)
def test_values_and_gradients_are_the_plain_paths(variant: str) -> None:
    model = scene(**VARIANTS[variant])
    recorded = recording(model)
    compared(model, recorded, [at(f) for f in (0, 1, 2.3, 3, 5, 0)])
    assert (recorded.mode, recorded.recordings) == ("cached", 1), recorded.reason


def emulated(model: SceneModel, monkeypatch: pytest.MonkeyPatch, **kwargs: Any) -> RecordedScene:
    """By graphs that a CPU can replay."""
    emulate(monkeypatch)
    made = RecordedScene(model, "auto", weight_of(model), launches=True, **kwargs)
    made.mode = "graph"
    return made


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_captured_holds_for_every_moment(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No number of the captured step stays in it, and nothing in it waits for a device."""
    model = scene(**VARIANTS[variant])
    recorded = emulated(model, monkeypatch)
    compared(model, recorded, [at(f) for f in (0, 1, 2.3, 5, 0)])
    with torch.no_grad():  # as an optimizer does
        for parameter in model.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
    compared(model, recorded, [at(4)])
    assert (recorded.mode, recorded.recordings) == ("graph", 1), recorded.reason


def test_state_is_the_plain_paths() -> None:
    model = scene()
    recorded = RecordedScene(model, "auto", weight_of(model), restrained=True, launches=True)
    recorded(at(1))
    state, plain = recorded(at(2)).state, model(at(2))
    assert recorded.recordings == 1
    assert list(state.gaussians) == list(plain.gaussians) and state.slices() == plain.slices()
    assert state.whole is not None and state.joined() is state.whole
    for only in (None, ["scene"], ["object", "human"]):
        for name, value in vars(plain.joined(only)).items():
            torch.testing.assert_close(getattr(state.joined(only), name), value)
    for name, residual in plain.residuals.items():
        for part, value in vars(residual).items():
            ours = getattr(state.residuals[name], part)
            assert (ours is None) == (value is None)
            if value is not None:
                torch.testing.assert_close(ours, value)
                assert ours.requires_grad
    for name, tokens in plain.tokens.items():
        torch.testing.assert_close(state.tokens[name].features, tokens.features)


def test_recorded_anew_only_when_something_changed() -> None:
    model = scene()
    recorded = recording(model)
    compared(model, recorded, [at(f) for f in (0, 1, 2)])
    model.interaction_enabled = False
    compared(model, recorded, [at(f) for f in (0, 1, 2)])
    assert recorded.recordings == 2
    wall = model.entity("scene")
    wall.resize(55)
    compared(model, recorded, [at(f) for f in (0, 1)])
    wall.resize(70)  # at every step: not worth a recording
    compared(model, recorded, [at(0)])
    wall.resize(50)
    compared(model, recorded, [at(0)])
    assert recorded.recordings == 3
    compared(model, recorded, [at(0)])
    model.entity("human").sh.requires_grad_(False)
    compared(model, recorded, [at(0), at(1)])
    assert recorded.recordings == 5
    with torch.no_grad():  # previews and evaluation are the model's own
        assert recorded(at(0)).penalties is None
    model.eval()
    assert recorded(at(0)).penalties is None
    model.train()
    compared(model, recorded, [at(3)])
    assert recorded.recordings == 5


def test_gradients_are_the_callers_own() -> None:
    """Neither the next step nor an accumulated gradient meets the recording's memory."""
    model = scene()
    recorded = recording(model)
    loss(recorded, model, at(0)).backward()
    model.zero_grad(set_to_none=True)
    loss(recorded, model, at(1)).backward()
    once, kept = gradients(model), {n: p.grad for n, p in model.named_parameters()}
    loss(recorded, model, at(1)).backward()  # added to what is there
    for name, gradient in once.items():
        if gradient is not None:
            torch.testing.assert_close(kept[name], 2 * gradient, rtol=1e-5, atol=1e-5)
    # an output that the loss does not use has no part in it, though it had one before
    model.zero_grad(set_to_none=True)
    recorded(at(1)).state.gaussians["human"].means.sum().backward()
    mine = gradients(model)
    model.zero_grad(set_to_none=True)
    model(at(1)).gaussians["human"].means.sum().backward()
    for name, gradient in gradients(model).items():
        ours = mine[name]
        assert ours is not None or gradient is None
        if ours is not None:
            wanted = torch.zeros_like(ours) if gradient is None else gradient
            torch.testing.assert_close(ours, wanted, rtol=1e-5, atol=1e-5)


def test_overwritten_outputs_have_no_gradient() -> None:
    model = scene()
    recorded = recording(model)
    recorded(at(0))
    first = loss(recorded, model, at(1))
    loss(recorded, model, at(2))
    with pytest.raises(RuntimeError, match="overwritten by a later one"):
        first.backward()


class Noisy(Static):
    """Says nothing about recordings, so what Static said does not hold for it."""


class Forgetful(DeformationModel):
    """Claims what is not so: a recording keeps its first time, or has no gradient."""

    recordable = True

    def __init__(self, cut: bool) -> None:
        super().__init__()
        self.cut = cut

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        if not isinstance(moment.time, Tensor):
            return replace(rest, means=rest.means + moment.time)
        means = rest.means.detach() + moment.time.float() if self.cut else rest.means + 1
        return replace(rest, means=means)


def test_what_cannot_be_recorded_says_why() -> None:
    def of(deformation: DeformationModel, **kwargs: Any) -> RecordedScene:
        rest = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
        model = SceneModel({"wall": Entity(rest, deformation)}, rasterizer=TorchRasterizer())
        return RecordedScene(model.train(), kwargs.pop("graphs", "auto"), lambda *_: 0, **kwargs)

    assert of(Noisy()).reason == "wall.deformation, a Noisy, is not recordable"
    assert "need a CUDA device" in of(Static()).reason
    assert of(Static(), graphs="off").reason == "train.graphs is off"
    with pytest.raises(HoigsError, match=r"train.graphs is on, but CUDA graphs need a CUDA device"):
        of(Static(), graphs="on")
    avatar = scene(person=lambda body, *_: TriplaneAvatar(body), unattended=True)
    recorded = RecordedScene(avatar, "auto", lambda *_: 0, launches=True)
    assert "human.deformation, a TriplaneAvatar" in recorded.reason
    wrong = of(Forgetful(cut=False), launches=True)
    wrong(at(2))
    with pytest.warns(UserWarning, match="without CUDA graphs: means of .* differs by"):
        values = wrong(at(2)).state.joined().means
    assert wrong.mode == "plain" and "differs" in wrong.reason
    assert torch.equal(values, wrong._model(at(2)).joined().means)
    wrong = of(Forgetful(cut=True), launches=True)
    wrong(at(2))
    with pytest.warns(UserWarning, match="does not have the plain path's outputs|has a gradient"):
        wrong(at(2))
    insisting = of(Forgetful(cut=False), launches=True, graphs="on")
    insisting(at(2))
    with pytest.raises(HoigsError, match=r"train.graphs is on, but means of"):
        insisting(at(2))


class Reads(Static):
    """Claims to be recordable, and asks the device for a number."""

    recordable = True

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        return replace(rest, means=rest.means * float(rest.means.detach().square().mean()))


def test_a_capture_that_fails_leaves_the_plain_path(monkeypatch: pytest.MonkeyPatch) -> None:
    rest = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
    model = SceneModel({"wall": Entity(rest, Reads())}, rasterizer=TorchRasterizer()).train()
    recorded = emulated(model, monkeypatch)
    recorded(at(2))
    with pytest.warns(UserWarning, match="not permitted when stream is capturing"):
        values = recorded(at(2)).state.joined().means
    assert recorded.mode == "plain" and torch.equal(values, model(at(2)).joined().means)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("variant", VARIANTS)
def test_cuda_graphs_equal_the_plain_path(variant: str) -> None:
    model = scene(**VARIANTS[variant]).to("cuda")
    recorded = RecordedScene(model, "on", weight_of(model))
    plain = RecordedScene(model, "off", weight_of(model))
    for frame in (0, 1, 2.3, 3, 5, 0):
        found = []
        for way in (recorded, plain):
            model.zero_grad(set_to_none=True)
            loss(way, model, at(frame)).backward()
            found.append(gradients(model))
        same_gradients(*found, 1e-4, 1e-6)
    assert (recorded.mode, recorded.recordings) == ("graph", 1), recorded.reason


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_capture_that_fails_leaves_the_plain_path() -> None:
    rest = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
    model = SceneModel({"wall": Entity(rest, Reads())}, rasterizer=TorchRasterizer())
    model = model.to("cuda").train()
    recorded = RecordedScene(model, "auto", lambda *_: 0.0)
    recorded(at(2))
    with pytest.warns(UserWarning, match="training goes on without CUDA graphs"):
        values = recorded(at(2)).state.joined().means
    assert recorded.mode == "plain"
    assert torch.equal(values, model(at(2).to("cuda")).joined().means)
    values.sum().backward()  # the device is none the worse
    assert torch.isfinite(model.entity("wall").means.grad).all()
