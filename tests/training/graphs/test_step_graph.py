"""Whole steps by one graph: losses, gradients and trajectories equal those of eager steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from graphed_cases import Noise, filmed, gradients, same_gradients, scene
from torch import Tensor

from hoigs.core.spec.train_schema import LossSpec, TrainSpec, WarmupSpec
from hoigs.metrics.kernels.image_loss import Target, image_losses
from hoigs.plugins.density.adc import AdaptiveDensity
from hoigs.rasterizers.warp.rasterizer import WarpRasterizer
from hoigs.training.step_graph import StepGradients
from hoigs.training.trainer import Trainer

SIZE, STEPS = 24, 24
NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, NO_CUDA])

pytestmark = pytest.mark.usefixtures("one_thread")


class Pictures(Noise):
    """Noise; masks that move, one of them empty in a frame; depth and ignored pixels in some."""

    def mask(self, entity: str, position: int) -> Tensor:
        mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
        if entity == "human":
            mask[6 : 16 + position, 6:12] = True
        elif position != 3:
            mask[6:18, 9 + position : 15 + position] = True
        return mask

    def depth(self, position: int) -> Tensor | None:
        return None if position == 1 else torch.full((SIZE, SIZE), 2.0 + 0.1 * position)

    def ignored(self, position: int) -> Tensor | None:
        if position != 4:
            return None
        return torch.arange(SIZE * SIZE).view(SIZE, SIZE) % 7 == 0


def trainer(device: str, graphs: Any, log_every: int = 50, **loss: Any) -> Trainer:
    spec = TrainSpec(
        steps=STEPS,
        preview_every=0,
        log_every=log_every,
        graphs=graphs,
        passes=5,
        warmup=WarmupSpec(motion=0.2, interaction=0.5, poses=0.1),
        loss=LossSpec(human_image="both", regularizers={"residual_pose": 0.1}, **loss),
    )
    model = scene()
    model.rasterizer = WarpRasterizer()
    density = {
        "scene": AdaptiveDensity(AdaptiveDensity.Config(interval=8, threshold=1e-9, cap=110))
    }
    return Trainer(
        model.to(device), filmed(Pictures(SIZE), depth_kind="metric"), spec, density=density
    )


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_steps_by_a_graph_are_eager_steps(device: str) -> None:
    """With an empty mask, a frame without depth, ignored pixels, density control, and people and
    objects at rest after 5 passes. What is drawn alone is drawn in the whole frame, so that the
    shape of a Gaussian far outside of the crop is another one."""
    plain, graphed = trainer(device, "off", 1), trainer(device, "auto", 1)
    if device == "cpu":
        assert graphed.gradients.mode == "plain" and "CUDA" in graphed.gradients.reason
        graphed.gradients = StepGradients(graphed.objective, "auto", kernel_by_kernel=True)
    reports: dict[str, list[Any]] = {"plain": [], "graphed": []}
    counts, compared = set(), 0
    while graphed.step < STEPS:
        if graphed.step:  # Adam makes whole steps of what is but rounding
            plain.resume(graphed.checkpoint())
        for name, run in (("plain", plain), ("graphed", graphed)):
            run.train(reports[name].append, until=run.step + 1)
        assert graphed.model.count() == plain.model.count()
        counts.add(graphed.model.count()["scene"])
        ours, theirs = gradients(graphed.model), gradients(plain.model)
        compared += same_gradients(ours, theirs, 1e-3, 1e-4)
    assert graphed.gradients.mode == ("cached" if device == "cpu" else "graph"), (
        graphed.gradients.reason
    )
    assert len(counts) > 1 and compared > 15 * STEPS
    # other pictures have other needs, and other counts or parts other graphs
    assert 3 <= graphed.gradients.captures <= 10
    for ours, theirs in zip(reports["graphed"], reports["plain"], strict=True):
        assert set(ours.losses) == set(theirs.losses)
        for term, value in theirs.losses.items():
            assert ours.losses[term] == pytest.approx(value, rel=1e-3, abs=1e-5), term
    statistics = [run.density["scene"].statistics for run in (plain, graphed)]
    torch.testing.assert_close(
        statistics[1].gradient_sum, statistics[0].gradient_sum, rtol=1e-3, atol=1e-5
    )


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_step_of_a_graph_that_is_not_finite_changes_nothing(device: str) -> None:
    graphed = trainer(device, "auto")
    if device == "cpu":
        graphed.gradients = StepGradients(graphed.objective, "auto", kernel_by_kernel=True)
    graphed.train(until=13)  # all parts take part since step 11
    curve = graphed.model.entity("object").get_parameter("deformation.tangents")
    with torch.no_grad():
        curve[0] = torch.nan
    before = {name: p.detach().clone() for name, p in graphed.model.named_parameters()}
    moments = {name: value.clone() for name, value in graphed.optimizer.tensors().items()}
    graphed.train(until=15)
    graphed.guard.read(lambda: None, wait=True)
    assert [step for step, _ in graphed.guard.skipped] == [14, 15]
    assert all("tangents" in culprit for _, culprit in graphed.guard.skipped)
    for name, parameter in graphed.model.named_parameters():
        assert torch.equal(parameter.nan_to_num(), before[name].nan_to_num()), name
    for name, value in graphed.optimizer.tensors().items():
        assert torch.equal(value, moments[name]), name
    assert torch.isfinite(graphed.density["scene"].statistics.gradient_sum).all()


@pytest.mark.parametrize(
    ("loss", "reason"),
    [
        ({"ssim": "torch"}, "ssim"),
        ({"scene_loss": "both"}, "scene_loss"),
        ({"depth_fit": "scale"}, "fitted"),
    ],
)
def test_what_no_graph_of_a_whole_step_holds(loss: dict[str, Any], reason: str) -> None:
    made = StepGradients(trainer("cpu", "auto", **loss).objective, "auto", kernel_by_kernel=True)
    assert made.mode == "plain" and reason in made.reason


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("by_area", [False, True])
def test_a_box_on_the_device_is_a_slice(device: str, by_area: bool) -> None:
    generator = torch.Generator().manual_seed(1)
    pixels = torch.randint(0, 256, (70, 90, 3), generator=generator, dtype=torch.uint8).to(device)
    shown, ignored = (torch.rand(70, 90, generator=generator).to(device) < p for p in (0.6, 0.2))
    background = torch.tensor((0.2, 0.5, 0.9), device=device)
    top, left, height, width, area = 7, 20, 41, 37, 500
    cut = (slice(top, top + height), slice(left, left + width))
    scale = 3.0 * (area if by_area else height * width)
    sliced = Target(pixels[cut], 0.7 / scale, 0.3, shown[cut], ignored[cut], background, top, left)
    box = torch.tensor((top, left, height, width, area), device=device, dtype=torch.int32)
    boxed = Target(pixels, 0.7, 0.3, shown, ignored, background, box=box, by_area=by_area)
    empty = replace(boxed, box=torch.zeros_like(box))
    renders = [
        torch.rand(70, 90, 3, generator=torch.Generator().manual_seed(2)).to(device) for _ in "ab"
    ]
    found = []
    for render, targets in zip(renders, ([sliced], [boxed, empty]), strict=True):
        losses = image_losses(render.requires_grad_(), targets)
        losses.sum().backward()
        found.append((losses, render.grad))
    assert found[1][0][1] == 0
    torch.testing.assert_close(found[1][0][:1], found[0][0], rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-5, atol=1e-8)
