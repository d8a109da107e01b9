"""KeptStages: the results of stages, kept in the work folder with what the stages noted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import hoigs
from hoigs.preparation.saved import from_result, to_result
from hoigs.preparation.stages.plan import PLAN
from hoigs.preparation.stages.progress import Stages
from hoigs.preparation.stages.work_folder import Result, WorkFolder, digest

FORMAT = 12  # of what the stages keep; another number makes older results unread
T = TypeVar("T")


class KeptStages:
    """Runs stages, or reads back what they gave before.

    Attributes:
        warnings, provenance: of all stages so far; a stage that is read back adds what it noted
            when it was made.
        worth_keeping: whether one that took long was made.
    """

    def __init__(self, stages: Stages, work: WorkFolder) -> None:
        self.stages, self.work = stages, work
        self.warnings: list[str] = []
        self.provenance: dict[str, str] = {}
        self.worth_keeping = False
        self._keys: dict[str, str] = {}

    def run(
        self,
        name: str,
        options: Mapping[str, Any],
        make: Callable[[], T],
        made_from: Any = None,
        save: Callable[[T], Result] = to_result,
        load: Callable[[Result], T] = from_result,
        remarks: Callable[[], Sequence[str]] = tuple,
    ) -> T:
        """A stage's result from the work folder; it is made first where it is not there.

        It is read back even when it has just been made, so that a resumed run gives the same as an
        unbroken one.

        Args:
            options: all of the preparation's, as JSON.
            made_from: JSON of whatever else the result depends on, beside PLAN's options.
            remarks: warnings of the video's reader, once the stage is made.
        """
        key = self._keys[name] = self.key(name, options, made_from)
        with self.stages.stage(name):
            stored = self.work.load(name, key)
            if stored is None:
                warned, known = len(self.warnings), dict(self.provenance)
                made = save(make())
                self.warnings += [text for text in remarks() if text not in self.warnings]
                notes: dict[str, Any] = {
                    "warnings": self.warnings[warned:],
                    "provenance": {k: v for k, v in self.provenance.items() if k not in known},
                    "seconds": self.stages.elapsed(),
                }
                values = {"made": made.values, "notes": notes}
                stored = self.work.save(
                    name, key, Result(values, made.arrays, made.files, made.folder)
                )
                self.worth_keeping |= PLAN[name].slow
            else:
                notes = stored.values["notes"]
                self.warnings += notes["warnings"]
                self.provenance |= notes["provenance"]
            value = load(Result(stored.values["made"], stored.arrays, None, stored.folder))
        self.stages.seconds[name] = notes["seconds"]
        return value

    def key(self, name: str, options: Mapping[str, Any], made_from: Any = None) -> str:
        """What a stage's result is stored under: a digest of all that it is made from."""
        stage = PLAN[name]
        return digest(
            {
                "format": [FORMAT, hoigs.__version__],
                "options": {key: options[key] for key in stage.options},
                "reads": {other: self._keys[other] for other in stage.reads},
                "from": made_from,
            }
        )

    def key_of(self, name: str) -> str:
        """The key of a stage that has run."""
        return self._keys[name]
