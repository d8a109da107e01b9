"""Graphed training steps: values and gradients of eager execution, or a reason why not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from emulated_graphs import emulate
from graphed_cases import (
    VARIANTS,
    at,
    compared,
    gradients,
    loss,
    same_gradients,
    scene,
    uncaptured,
    weight_of,
)
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.deformation.zoo.triplane_avatar import TriplaneAvatar
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.graphs import GraphedScene

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("variant", VARIANTS)
def test_values_and_gradients_are_those_of_eager_execution(variant: str) -> None:
    model = scene(**VARIANTS[variant])
    graphed = uncaptured(model)
    compared(model, graphed, [at(f) for f in (0, 1, 2.3, 3, 5, 0)])
    assert (graphed.mode, graphed.captures) == ("cached", 1), graphed.reason


def emulated(model: SceneModel, monkeypatch: pytest.MonkeyPatch, **kwargs: Any) -> GraphedScene:
    """By graphs that a CPU can replay."""
    emulate(monkeypatch)
    made = GraphedScene(model, "auto", weight_of(model), kernel_by_kernel=True, **kwargs)
    made.mode = "graph"
    return made


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_captured_holds_for_every_moment(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No number of the captured step stays in it, and nothing in it waits for a device."""
    model = scene(**VARIANTS[variant])
    graphed = emulated(model, monkeypatch)
    compared(model, graphed, [at(f) for f in (0, 1, 2.3, 5, 0)])
    with torch.no_grad():  # as an optimizer does
        for parameter in model.parameters():
            parameter += 0.01 * torch.randn_like(parameter)
    compared(model, graphed, [at(4)])
    assert (graphed.mode, graphed.captures) == ("graph", 1), graphed.reason


def test_state_is_that_of_eager_execution() -> None:
    model = scene()
    graphed = GraphedScene(model, "auto", weight_of(model), restrained=True, kernel_by_kernel=True)
    graphed(at(1))
    state, plain = graphed(at(2)).state, model(at(2))
    assert graphed.captures == 1
    assert list(state.gaussians) == list(plain.gaussians) and state.slices() == plain.slices()
    assert state.whole is not None and state.joined() is state.whole
    for only in (None, ["scene"], ["object", "human"]):
        for name, value in plain.joined(only).tensors().items():
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


def test_captured_again_only_when_something_changed() -> None:
    model = scene()
    graphed = uncaptured(model)
    compared(model, graphed, [at(f) for f in (0, 1, 2)])
    model.interaction_enabled = False
    compared(model, graphed, [at(f) for f in (0, 1, 2)])
    assert graphed.captures == 2
    wall = model.entity("scene")
    wall.resize(55)
    compared(model, graphed, [at(f) for f in (0, 1)])
    wall.resize(70)  # at every step: not worth a capture
    compared(model, graphed, [at(0)])
    wall.resize(50)
    compared(model, graphed, [at(0)])
    assert graphed.captures == 3
    compared(model, graphed, [at(0)])
    model.entity("human").sh.requires_grad_(False)
    compared(model, graphed, [at(0), at(1)])
    assert graphed.captures == 5
    with torch.no_grad():  # previews and evaluation call the model directly
        assert graphed(at(0)).penalties is None
    model.eval()
    assert graphed(at(0)).penalties is None
    model.train()
    compared(model, graphed, [at(3)])
    assert graphed.captures == 5


def test_gradients_are_the_callers_own() -> None:
    """Neither the next step nor an accumulated gradient uses the graph's memory."""
    model = scene()
    graphed = uncaptured(model)
    loss(graphed, model, at(0)).backward()
    model.zero_grad(set_to_none=True)
    loss(graphed, model, at(1)).backward()
    once, kept = gradients(model), {n: p.grad for n, p in model.named_parameters()}
    loss(graphed, model, at(1)).backward()  # added to what is there
    for name, gradient in once.items():
        if gradient is not None:
            torch.testing.assert_close(kept[name], 2 * gradient, rtol=1e-5, atol=1e-5)
    # an output that the loss does not use has no part in it, though it had one before
    model.zero_grad(set_to_none=True)
    graphed(at(1)).state.gaussians["human"].means.sum().backward()
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
    graphed = uncaptured(model)
    graphed(at(0))
    first = loss(graphed, model, at(1))
    loss(graphed, model, at(2))
    with pytest.raises(RuntimeError, match="overwritten by a later one"):
        first.backward()


class Noisy(Static):
    """Declares nothing about graphs; Static's declaration does not extend to a subclass."""


class Forgetful(DeformationModel):
    """Declares cuda_graph_safe wrongly: a graph keeps its first time, or has no gradient."""

    cuda_graph_safe = True

    def __init__(self, cut: bool) -> None:
        super().__init__()
        self.cut = cut

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        if not isinstance(moment.time, Tensor):
            return replace(canonical, means=canonical.means + moment.time)
        means = canonical.means.detach() + moment.time.float() if self.cut else canonical.means + 1
        return replace(canonical, means=means)


def test_the_reason_for_eager_steps_is_given() -> None:
    def of(deformation: DeformationModel, **kwargs: Any) -> GraphedScene:
        canonical = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
        model = SceneModel({"wall": Entity(canonical, deformation)}, rasterizer=TorchRasterizer())
        return GraphedScene(model.train(), kwargs.pop("graphs", "auto"), lambda *_: 0, **kwargs)

    assert of(Noisy()).reason == "wall.deformation, a Noisy, is not cuda_graph_safe"
    assert "need a CUDA device" in of(Static()).reason
    assert of(Static(), graphs="off").reason == "train.graphs is off"
    with pytest.raises(HoigsError, match=r"train.graphs is on, but CUDA graphs need a CUDA device"):
        of(Static(), graphs="on")
    avatar = scene(
        person=lambda body, *_: TriplaneAvatar(
            TriplaneAvatar.Config(refine_poses=False), body=body
        ),
        unattended=True,
    )
    graphed = GraphedScene(avatar, "auto", lambda *_: 0, kernel_by_kernel=True)
    assert "human.deformation, a TriplaneAvatar" in graphed.reason
    wrong = of(Forgetful(cut=False), kernel_by_kernel=True)
    wrong(at(2))
    with pytest.warns(UserWarning, match="without CUDA graphs: means of .* differs by"):
        values = wrong(at(2)).state.joined().means
    assert wrong.mode == "plain" and "differs" in wrong.reason
    assert torch.equal(values, wrong._model(at(2)).joined().means)
    wrong = of(Forgetful(cut=True), kernel_by_kernel=True)
    wrong(at(2))
    with pytest.warns(UserWarning, match="does not have the outputs of eager|has a gradient"):
        wrong(at(2))
    insisting = of(Forgetful(cut=False), kernel_by_kernel=True, graphs="on")
    insisting(at(2))
    with pytest.raises(HoigsError, match=r"train.graphs is on, but means of"):
        insisting(at(2))


class Reads(Static):
    """Claims to be cuda_graph_safe, and reads a number from the device."""

    cuda_graph_safe = True

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        return replace(
            canonical, means=canonical.means * float(canonical.means.detach().square().mean())
        )


def test_a_capture_that_fails_falls_back_to_eager_execution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    canonical = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
    model = SceneModel({"wall": Entity(canonical, Reads())}, rasterizer=TorchRasterizer()).train()
    graphed = emulated(model, monkeypatch)
    graphed(at(2))
    with pytest.warns(UserWarning, match="not permitted when stream is capturing"):
        values = graphed(at(2)).state.joined().means
    assert graphed.mode == "plain" and torch.equal(values, model(at(2)).joined().means)
    assert graphed.why_slower() is None  # on a CPU graphs would not be faster
    monkeypatch.setattr(SceneModel, "device", torch.device("cuda"))
    assert graphed.why_slower() == graphed.reason and "capturing" in graphed.reason
    assert GraphedScene(model, "off", weight_of(model)).why_slower() is None


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("variant", VARIANTS)
def test_cuda_graphs_equal_eager_execution(variant: str) -> None:
    model = scene(**VARIANTS[variant]).to("cuda")
    graphed = GraphedScene(model, "on", weight_of(model))
    plain = GraphedScene(model, "off", weight_of(model))
    for frame in (0, 1, 2.3, 3, 5, 0):
        found = []
        for way in (graphed, plain):
            model.zero_grad(set_to_none=True)
            loss(way, model, at(frame)).backward()
            found.append(gradients(model))
        same_gradients(*found, 1e-4, 1e-6)
    assert (graphed.mode, graphed.captures) == ("graph", 1), graphed.reason


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_capture_that_fails_falls_back_to_eager_execution() -> None:
    canonical = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
    model = SceneModel({"wall": Entity(canonical, Reads())}, rasterizer=TorchRasterizer())
    model = model.to("cuda").train()
    graphed = GraphedScene(model, "auto", lambda *_: 0.0)
    graphed(at(2))
    with pytest.warns(UserWarning, match="training continues without CUDA graphs"):
        values = graphed(at(2)).state.joined().means
    assert graphed.mode == "plain"
    assert torch.equal(values, model(at(2).to("cuda")).joined().means)
    values.sum().backward()  # the device still works
    assert torch.isfinite(model.entity("wall").means.grad).all()
