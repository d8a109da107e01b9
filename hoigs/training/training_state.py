"""All that a training changes, as a checkpoint and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch

from hoigs.core.errors import CheckpointError
from hoigs.core.interfaces.density import DensityStatistics
from hoigs.core.model.camera_refinement import CameraRefinement
from hoigs.core.model.scene import SceneModel
from hoigs.runs.checkpoint import (
    FORMAT,
    VERSION,
    Checkpoint,
    restore_cameras,
    restore_model,
)
from hoigs.training.density_update import EntityDensity
from hoigs.training.nan_guard import NanGuard
from hoigs.training.optimizer import GroupedAdam
from hoigs.training.sampler import EpochSampler
from hoigs.training.time_windows import TimeWindows
from hoigs.training.unseen import Filling


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
