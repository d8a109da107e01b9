"""Training runs that are recorded: every step's gradients, and the whole way, as the plain ones."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from emulated_graphs import emulate
from recorded_scene import FRAMES, apart, at, gradients, loss, same_gradients, scene
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import Clip, FrameStore
from hoigs.core.train_spec import LossSpec, TrainSpec, WarmupSpec
from hoigs.plugins.density.adc import AdaptiveDensity
from hoigs.training.recorded import RecordedScene
from hoigs.training.trainer import Trainer

SIZE, STEPS = 24, 30


pytestmark = pytest.mark.usefixtures("one_thread")


class Pictures(FrameStore):
    """Coloured noise, and masks of the middle."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(3)
        self.images = torch.randint(0, 256, (FRAMES, SIZE, SIZE, 3), generator=generator)

    def image(self, position: int) -> Tensor:
        return self.images[position].to(torch.uint8)

    def mask(self, entity: str, position: int) -> Tensor:
        mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
        mask[6:18, 6:12] = entity == "human"
        mask[6:18, 12:18] = entity == "object"
        return mask

    def depth(self, position: int) -> Tensor | None:
        return None


def trainer(device: str = "cpu", graphs: Any = "auto") -> Trainer:
    cameras = [
        Camera.look_at(
            torch.tensor((0.2 * i - 0.5, 0.2, -2.5)), torch.tensor((0.0, 0.0, 0.5)),
            width=SIZE, height=SIZE, fov_y=0.9, up=(0.0, -1.0, 0.0),
        )
        for i in range(FRAMES)
    ]  # fmt: skip
    clip = Clip(
        "noise",
        Pictures(),
        cameras,
        [at(f) for f in range(FRAMES)],
        kinds={"human": "human", "object": "object"},
        bodies={},
        objects={},
        points=torch.rand(9, 3),
        point_colors=torch.rand(9, 3),
        split={"train": [0, 1, 3, 4], "test": [2, 5]},
    )
    spec = TrainSpec(
        steps=STEPS,
        preview_every=0,
        graphs=graphs,
        warmup=WarmupSpec(motion=0.2, interaction=0.5, poses=0.1),
        loss=LossSpec(ssim="torch", regularizers={"residual_pose": 0.1}),
    )
    density = {"scene": AdaptiveDensity(interval=8, stop=0.9, threshold=1e-9, cap=110)}
    return Trainer(scene().to(device), clip, spec, density=density)


def by_launches(made: Trainer) -> Trainer:
    """What a GPU does by default, without graphs."""
    objective = made.objective
    assert objective.recorded.mode == "plain" and "CUDA" in objective.recorded.reason
    objective.recorded = RecordedScene(
        made.model, "auto", objective.weight_of, restrained=True, launches=True
    )
    return made


def side_by_side(recorded: Trainer, plain: Trainer, allowed: float) -> set[int]:
    """Train, and at every step compare gradients; the counts that the scene had."""
    counts, compared = set(), 0
    while recorded.step < STEPS:
        if recorded.step:  # Adam makes whole steps of what is but rounding
            plain.resume(recorded.checkpoint())
        for run in (plain, recorded):
            run.train(until=run.step + 1)
        assert recorded.model.count() == plain.model.count()
        counts.add(recorded.model.count()["scene"])
        ours, theirs = gradients(recorded.model), gradients(plain.model)
        compared += same_gradients(ours, theirs, allowed, 1e-3 * allowed)
    assert len(counts) > 2 and compared > 20 * STEPS  # topology did change
    # Adam's too: what has no gradient has no state
    assert set(recorded.checkpoint().tensors) == set(plain.checkpoint().tensors)
    return counts


def test_a_training_run_takes_the_same_way() -> None:
    """Adam, density control, warm-ups and pose refinement included."""
    plain, recorded = trainer(graphs="off"), by_launches(trainer())
    pose = recorded.model.entity("human").get_parameter("deformation.refinement.pose")
    before = pose.detach().clone()
    counts, scenes = side_by_side(recorded, plain, 1e-5), recorded.objective.recorded
    assert scenes.mode == "cached", scenes.reason
    assert len(counts) <= scenes.recordings <= len(counts) + 1
    assert not torch.equal(pose.detach(), before)


def test_a_training_run_by_captured_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    emulate(monkeypatch)
    plain, recorded = trainer(graphs="off"), by_launches(trainer())
    scenes = recorded.objective.recorded
    scenes.mode = "graph"
    counts = side_by_side(recorded, plain, 1e-5)
    assert scenes.mode == "graph", scenes.reason
    assert len(counts) <= scenes.recordings <= len(counts) + 1


def test_recorded_runs_resume() -> None:
    by_launches(trainer()).train(until=20)  # a process's first run rounds unlike its later ones
    whole = by_launches(trainer())
    whole.train(until=12)
    stored = whole.checkpoint()
    stored = replace(stored, tensors={k: v.clone() for k, v in stored.tensors.items()})
    whole.train(until=20)
    resumed = by_launches(trainer())
    resumed.resume(stored)
    resumed.train(until=20)
    assert resumed.objective.recorded.recordings == 2  # the shapes of steps 12 and 16
    for name, value in whole.checkpoint().tensors.items():
        if value.is_floating_point() and not name.startswith("density"):
            assert apart(resumed.checkpoint().tensors[name], value) < 1e-4, name
    copy.deepcopy(whole.model)  # nothing of a recording hangs on the model


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_training_by_graphs() -> None:
    """Through density control and warm-ups; the memory of old recordings goes back."""
    plain, recorded = trainer("cuda", graphs="off"), trainer("cuda", graphs="on")
    counts, scenes = side_by_side(recorded, plain, 1e-3), recorded.objective.recorded
    assert scenes.mode == "graph", scenes.reason
    assert len(counts) <= scenes.recordings <= len(counts) + 1
    taken = []
    for size in (50, 60, 50, 60, 50):
        recorded.model.entity("scene").resize(size)
        recorded.model.train()
        recorded.optimizer.zero_grad()
        for frame in (0, 1, 2):
            loss(scenes, recorded.model, at(frame)).backward()
            recorded.optimizer.zero_grad()
        taken.append(torch.cuda.memory_allocated())
    assert scenes.recordings >= len(taken)
    assert taken[4] < taken[2] + (1 << 20)  # of the same size again
