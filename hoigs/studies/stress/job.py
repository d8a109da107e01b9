"""StressJob: one short training on one value of a knob, and by which clip it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from hoigs.studies.job import Job


@dataclass(frozen=True)
class StressJob(Job):
    """A Job with what a broken clip needs.

    Attributes:
        judge: folder of the clip whose test frames judge; "" is the training clip's own.
        allow_faults: go on with what the clip lacks.
    """

    worker: ClassVar[str] = "hoigs.studies.stress.worker"

    judge: str = ""
    allow_faults: bool = False

    @property
    def identity(self) -> dict[str, str]:
        return super().identity | ({"judge": Path(self.judge).name} if self.judge else {})
