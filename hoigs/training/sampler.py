"""Which training frame comes next: every frame once, in a new order each epoch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


class EpochSampler:
    """Shuffled passes over `positions`; its state is part of a checkpoint."""

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
        self.queue = list(state["queue"])
