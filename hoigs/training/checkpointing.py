"""CheckpointWriter: when training writes checkpoints, and which older ones it removes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from hoigs.core.spec.train_schema import TrainSpec
from hoigs.runs.checkpoint import Checkpoint, complete_checkpoints, remove_checkpoint
from hoigs.runs.run_folder import RunFolder

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
