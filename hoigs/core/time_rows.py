"""Parameters whose rows belong to times of the clip, of which only some may be there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from torch import nn

MARGIN = 2  # rows beside those about a time that an interpolation may read


@dataclass
class TimeRows:
    """Rows along axis 1 of a parameter, at times evenly spread over [0, 1].

    A module has `time_rows`, a TimeRows by the name of each such parameter of its own. Training in
    windows then keeps the rows of one window alone, and sets `first`; whoever reads the parameter
    counts its rows from there.

    Attributes:
        count: T, of all rows; row i belongs to time i / (T - 1).
        first: number of the first row that is there.
    """

    count: int
    first: int = 0

    def about(self, start: float, end: float) -> slice:
        """The rows that are read between two times."""
        last = self.count - 1
        first = max(0, math.floor(start * last) - MARGIN)
        return slice(first, min(self.count, math.ceil(end * last) + MARGIN + 1))

    def local(self, time: Any, present: int) -> Any:
        """A time in [0, 1] as the part of the way from the first to the last row that is there.

        Args:
            present: number of these rows.
        """
        if present == self.count:
            return time
        return (time * (self.count - 1) - self.first) / max(1, present - 1)


def timed_parameters(model: nn.Module) -> Iterator[tuple[str, TimeRows]]:
    """The dotted name of every parameter that has rows for times."""
    for path, module in model.named_modules():
        for name, rows in getattr(module, "time_rows", {}).items():
            yield f"{path}.{name}", rows
