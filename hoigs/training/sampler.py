"""EpochSampler: every training frame once an epoch, in a new order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


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
