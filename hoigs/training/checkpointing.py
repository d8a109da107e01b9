"""CheckpointWriter: when training writes checkpoints, and which older ones it removes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch

from hoigs.core.errors import CheckpointError
from hoigs.core.interfaces.density import DensityStatistics
from hoigs.core.model.camera_refinement import CameraRefinement
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import TrainSpec
from hoigs.runs.checkpoint import (
    FORMAT,
    VERSION,
    Checkpoint,
    complete_checkpoints,
    remove_checkpoint,
    restore_cameras,
    restore_model,
)
from hoigs.runs.run_folder import RunFolder
from hoigs.training.density import EntityDensity
from hoigs.training.nan_guard import NanGuard
from hoigs.training.optimizer import GroupedAdam
from hoigs.training.time_windows import TimeWindows
from hoigs.training.unseen import Filling

VIEW_SECONDS = 10.0  # between checkpoints that are written to be looked at
VIEW_SHARE = 0.05  # of the time of a training that writing them may take


class CheckpointWriter:
    """Writes the checkpoints of one training.

    Besides those of `checkpoint_every` there may be others, for a viewer that follows the training:
    they come by time, and only the last two of them are kept, so that a reader has the time to read
    one.

    Args:
        make: the present state of the training.
        viewed: whether to write those for a viewer, beginning with the first step.
    """

    def __init__(
        self, run: RunFolder, spec: TrainSpec, make: Callable[[], Checkpoint], viewed: bool = False
    ) -> None:
        self.run, self.spec, self.make, self.viewed = run, spec, make, viewed
        self._temporary: list[int] = []  # steps of those for a viewer
        self._next = 0.0

    def after(self, step: int, stopping: bool) -> None:
        """Write what is due after a step.

        Args:
            stopping: whether the training stops here.

        Raises:
            HoigsError: another process took the run folder over, or it cannot be written.
        """
        due = stopping or step == self.spec.steps or step % self.spec.checkpoint_every == 0
        shown = self.viewed and time.monotonic() >= self._next
        if not due and not shown:
            return
        self.run.require_lock()
        began = time.monotonic()
        self.make().save(self.run.checkpoints)
        ended = time.monotonic()
        self._next = ended + max(VIEW_SECONDS, (ended - began) / VIEW_SHARE)
        self._remove(step, due, finished=stopping or step == self.spec.steps)

    def _remove(self, step: int, due: bool, finished: bool) -> None:
        """Remove older checkpoints, once a newer one is whole."""
        if not due:
            self._temporary.append(step)
        for old in self._temporary[: None if finished else -2]:
            self._temporary.remove(old)
            remove_checkpoint(self.run.checkpoints, old)
        if self.spec.keep_checkpoints is None:
            return
        lasting = [n for n in complete_checkpoints(self.run.checkpoints) if n <= step]
        lasting = [n for n in lasting if n not in self._temporary]
        for old in lasting[: -self.spec.keep_checkpoints]:
            remove_checkpoint(self.run.checkpoints, old)


# EpochSampler: every training frame once an epoch, in a new order.


class EpochSampler:
    """Shuffled passes over `positions`; a checkpoint holds its state.

    Raises:
        ValueError: there are no positions.
    """

    def __init__(self, positions: Sequence[int], generator: torch.Generator) -> None:
        if not positions:
            raise ValueError("no frames to train on: the clip's split has no 'train' positions")
        self.positions, self.generator = list(positions), generator
        self.queue: list[int] = []

    def next(self) -> int:
        if not self.queue:
            order = torch.randperm(len(self.positions), generator=self.generator).tolist()
            self.queue = [self.positions[i] for i in order]
        return self.queue.pop()

    def state(self) -> dict[str, Any]:
        return {"queue": list(self.queue)}

    def load(self, state: dict[str, Any]) -> None:
        unknown = sorted(set(state["queue"]) - set(self.positions))
        if unknown:
            raise ValueError(f"frames {unknown[:5]} are not among those that are trained on")
        self.queue = list(state["queue"])


# All that a training changes, as a checkpoint and back.


class TrainingState(Protocol):
    """The parts of a Trainer that change from step to step, and how far it is.

    Attributes:
        density: controllers with their statistics, by entity. cameras: their corrections.
        windows: pieces of a long clip that are trained in turns. unseen: what was hidden.
        identity: stored in checkpoints to recognise the spec (spec_name, model_hash).
        hashes: of checkpoints that may be resumed from.
        step: that was trained last. elapsed: seconds of training until now.
    """

    model: SceneModel
    optimizer: GroupedAdam
    density: dict[str, EntityDensity]
    cameras: CameraRefinement | None
    windows: TimeWindows | None
    unseen: Filling
    sampler: EpochSampler
    generator: torch.Generator
    guard: NanGuard
    identity: dict[str, str]
    hashes: Sequence[str]
    step: int
    elapsed: float


def checkpoint_of(state: TrainingState, finished: bool) -> Checkpoint:
    """The complete state; see Checkpoint.

    Args:
        finished: whether the training is over.
    """
    files = {} if state.windows is None else state.windows.files(finished)
    tensors = {f"model.{k}": v for k, v in state.model.state_dict().items()}
    tensors |= {f"optimizer.{k}": v for k, v in state.optimizer.tensors().items()}
    for name, density in state.density.items():
        tensors |= {f"density.{name}.{k}": v for k, v in vars(density.statistics).items()}
    if state.cameras is not None:
        tensors |= {f"cameras.{k}": v for k, v in state.cameras.state_dict().items()}
    if state.windows is not None:
        tensors |= {f"windows.{k}": v for k, v in state.windows.state().items()}
    tensors |= {f"hidden.{k}": v for k, v in state.unseen.hidden.items()}
    tensors["rng.generator"] = state.generator.get_state()
    tensors["rng.torch"] = torch.get_rng_state()
    meta = {
        "format": FORMAT,
        "version": VERSION,
        "step": state.step,
        "time_s": state.elapsed,
        "counts": state.model.count(),
        "sampler": state.sampler.state(),
        "skipped": state.guard.skipped,
        **state.identity,
    }
    return Checkpoint(tensors, meta, files)


def restore(state: TrainingState, checkpoint: Checkpoint) -> None:
    """Everything as it was; the rest of the run then equals an unbroken one.

    Raises:
        CheckpointError: it belongs to another spec or clip, is damaged, or holds a model alone.
    """
    if not checkpoint.part("optimizer"):
        raise CheckpointError(
            f"the checkpoint of step {checkpoint.meta['step']} was pruned or compressed: it "
            "has a model, but no optimizer state to resume with"
        )
    try:
        _restore(state, checkpoint)
    except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(
            f"the checkpoint of step {checkpoint.meta['step']} is damaged: {error}"
        ) from error


def _restore(state: TrainingState, checkpoint: Checkpoint) -> None:
    restore_model(state.model, checkpoint, state.hashes)
    restore_cameras(state.cameras, checkpoint)
    state.optimizer.load_tensors(checkpoint.part("optimizer"))
    for name, density in state.density.items():
        stored = checkpoint.part(f"density.{name}")
        density.statistics = DensityStatistics.zeros(len(density.entity), state.model.device)
        for key, value in stored.items():
            setattr(density.statistics, key, value.to(state.model.device).clone())
    hidden = checkpoint.part("hidden")
    state.unseen.hidden = {name: kept.to(state.model.device) for name, kept in hidden.items()}
    state.generator.set_state(checkpoint.tensors["rng.generator"])
    torch.set_rng_state(checkpoint.tensors["rng.torch"])
    state.sampler.load(checkpoint.meta["sampler"])
    if state.windows is not None:
        state.windows.load(checkpoint.part("windows"))
    state.step = checkpoint.meta["step"]
    state.elapsed = checkpoint.meta["time_s"]
