"""The paper's numbers, from paper.yaml; they are shown as published on other data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

from hoigs.core.errors import did_you_mean

METRICS = ("psnr", "lpips", "cd_best")


@dataclass(frozen=True)
class Published:
    """One row of one of the paper's tables.

    Attributes:
        source: its table. data: what it was measured on. scenes: how many.
        means: of the rows that the paper gives, by metric. printed: its own averages; where the
            two disagree, the paper contradicts itself.
    """

    source: str
    data: str
    row: str
    scenes: int
    means: dict[str, float]
    printed: dict[str, float]

    def value(self, metric: str) -> float | None:
        """The mean of the scenes where they are given, else what is printed."""
        return self.means.get(metric, self.printed.get(metric))


@cache
def _tables() -> dict[str, Any]:
    import yaml

    with Path(__file__).with_name("paper.yaml").open() as file:
        tables: dict[str, Any] = yaml.safe_load(file)
    return tables


def published(reference: str) -> Published:
    """The row "TABLE/ROW" of paper.yaml.

    Raises:
        KeyError: there is none.
    """
    table, _, row = reference.partition("/")
    known = [f"{name}/{r}" for name, content in _tables().items() for r in content["rows"]]
    if reference not in known:
        raise KeyError(f"{reference!r} is not in paper.yaml{did_you_mean(reference, known)}")
    content = _tables()[table]
    numbers = content["rows"][row]
    means = {m: mean(numbers[m]) for m in METRICS if m in numbers}
    scenes = len(content.get("scenes", ()))
    return Published(
        content["source"], content["data"], row, scenes, means, numbers.get("printed", {})
    )
