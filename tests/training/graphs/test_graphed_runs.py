"""Training by graphed steps: gradients and trajectories equal those of eager steps."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from emulated_graphs import emulate
from graphed_cases import Noise, apart, at, filmed, gradients, loss, same_gradients, scene
from torch import Tensor

from hoigs.core.spec.train_schema import LossSpec, TrainSpec, WarmupSpec
from hoigs.plugins.density.adc import AdaptiveDensity
from hoigs.training.graphs import GraphedScene
from hoigs.training.trainer import Trainer

SIZE, STEPS = 24, 30


pytestmark = pytest.mark.usefixtures("one_thread")


class Pictures(Noise):
    """Coloured noise, and masks of the middle."""

    def mask(self, entity: str, position: int) -> Tensor:
        mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
        mask[6:18, 6:12] = entity == "human"
        mask[6:18, 12:18] = entity == "object"
        return mask


def trainer(device: str = "cpu", graphs: Any = "auto", passes: int | None = None) -> Trainer:
    spec = TrainSpec(
        steps=STEPS,
        preview_every=0,
        graphs=graphs,
        passes=passes,
        warmup=WarmupSpec(motion=0.2, interaction=0.5, poses=0.1),
        loss=LossSpec(ssim="torch", regularizers={"residual_pose": 0.1}),
    )
    density = {
        "scene": AdaptiveDensity(
            AdaptiveDensity.Config(interval=8, stop=0.9, threshold=1e-9, cap=110)
        )
    }
    return Trainer(scene().to(device), filmed(Pictures(SIZE)), spec, density=density)


def without_capture(made: Trainer) -> Trainer:
    """Graphed steps launched kernel by kernel, which works on a CPU."""
    objective = made.objective
    assert objective.graphed_scene.mode == "plain" and "CUDA" in objective.graphed_scene.reason
    objective.graphed_scene = GraphedScene(
        made.model, "auto", objective.weight_of, restrained=True, kernel_by_kernel=True
    )
    return made


def side_by_side(graphed: Trainer, plain: Trainer, allowed: float) -> set[int]:
    """Train, and at every step compare gradients; the counts that the scene had."""
    counts, compared = set(), 0
    while graphed.step < STEPS:
        if graphed.step:  # Adam makes whole steps of what is but rounding
            plain.resume(graphed.checkpoint())
        for run in (plain, graphed):
            run.train(until=run.step + 1)
        assert graphed.model.count() == plain.model.count()
        counts.add(graphed.model.count()["scene"])
        ours, theirs = gradients(graphed.model), gradients(plain.model)
        compared += same_gradients(ours, theirs, allowed, 1e-3 * allowed)
    assert len(counts) > 2 and compared > 20 * STEPS  # topology did change
    # Adam's too: what has no gradient has no state
    assert set(graphed.checkpoint().tensors) == set(plain.checkpoint().tensors)
    return counts


def test_a_training_run_takes_the_same_way() -> None:
    """Adam, density control, warm-ups and pose refinement included."""
    plain, graphed = trainer(graphs="off"), without_capture(trainer())
    pose = graphed.model.entity("human").get_parameter("deformation.refinement.pose")
    before = pose.detach().clone()
    counts, scenes = side_by_side(graphed, plain, 1e-5), graphed.objective.graphed_scene
    assert scenes.mode == "cached", scenes.reason
    assert len(counts) <= scenes.captures <= len(counts) + 1
    assert not torch.equal(pose.detach(), before)


def test_a_training_run_by_captured_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    emulate(monkeypatch)
    plain, graphed = trainer(graphs="off"), without_capture(trainer())
    scenes = graphed.objective.graphed_scene
    scenes.mode = "graph"
    counts = side_by_side(graphed, plain, 1e-5)
    assert scenes.mode == "graph", scenes.reason
    assert len(counts) <= scenes.captures <= len(counts) + 1


def test_graphed_runs_resume() -> None:
    without_capture(trainer()).train(until=20)  # a process's first run rounds unlike its later ones
    whole = without_capture(trainer())
    whole.train(until=12)
    stored = whole.checkpoint()
    stored = replace(stored, tensors={k: v.clone() for k, v in stored.tensors.items()})
    whole.train(until=20)
    resumed = without_capture(trainer())
    resumed.resume(stored)
    resumed.train(until=20)
    assert resumed.objective.graphed_scene.captures == 2  # the shapes of steps 12 and 16
    for name, value in whole.checkpoint().tensors.items():
        if value.is_floating_point() and not name.startswith("density"):
            assert apart(resumed.checkpoint().tensors[name], value) < 1e-4, name
    copy.deepcopy(whole.model)  # the model holds no part of a graph


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_training_by_graphs() -> None:
    """Through density control and warm-ups; the memory of old graphs is freed."""
    plain, graphed = trainer("cuda", graphs="off"), trainer("cuda", graphs="on")
    counts, scenes = side_by_side(graphed, plain, 1e-3), graphed.objective.graphed_scene
    assert scenes.mode == "graph", scenes.reason
    assert len(counts) <= scenes.captures <= len(counts) + 1
    taken = []
    for size in (50, 60, 50, 60, 50):
        graphed.model.entity("scene").resize(size)
        graphed.model.train()
        graphed.optimizer.zero_grad()
        for frame in (0, 1, 2):
            loss(scenes, graphed.model, at(frame)).backward()
            graphed.optimizer.zero_grad()
        taken.append(torch.cuda.memory_allocated())
    assert scenes.captures >= len(taken)
    assert taken[4] < taken[2] + (1 << 20)  # of the same size again


@pytest.mark.parametrize("graphed", [False, True])
def test_people_and_objects_stay_after_their_passes(graphed: bool) -> None:
    """The scene trains on; a run that is resumed after them goes the same way."""
    make = (lambda: without_capture(trainer(passes=4))) if graphed else lambda: trainer(passes=4)
    make().train(until=20)  # a process's first run rounds unlike its later ones
    whole = make()
    settled = 4 * len(whole.clip.split["train"])
    whole.train(until=settled)
    before = {name: value.clone() for name, value in whole.model.state_dict().items()}
    whole.train(until=settled + 4)
    stored = whole.checkpoint()
    stored = replace(stored, tensors={k: v.clone() for k, v in stored.tensors.items()})
    whole.train()
    for name, value in whole.model.state_dict().items():
        own = not name.startswith("entities.scene.")
        assert not own or torch.equal(value, before[name]), name
    first, scene = before["entities.scene.sh"], whole.model.entity("scene").sh
    assert len(first) != len(scene) or not torch.equal(first, scene)
    resumed = make()
    resumed.resume(stored)
    resumed.train()
    if not graphed:  # the first steps of a run are not graphed, and round otherwise
        ours, theirs = resumed.model.state_dict(), whole.model.state_dict()
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
