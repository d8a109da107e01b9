"""StressJob: one short training at one value of a sweep, and the clip that scores it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from hoigs.studies.jobs.job import Job


@dataclass(frozen=True)
class StressJob(Job):
    """A Job that may be scored on another clip.

    Attributes:
        scoring_clip: folder of the clip whose test frames score the model; "" is the training clip.
        allow_faults: train in spite of faults of the clip.
    """

    worker: ClassVar[str] = "hoigs.studies.stress.worker"

    scoring_clip: str = ""
    allow_faults: bool = False

    @property
    def identity(self) -> dict[str, str]:
        scoring = {"judge": Path(self.scoring_clip).name} if self.scoring_clip else {}
        return super().identity | scoring
