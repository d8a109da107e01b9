"""State of a row on disk: which stages are done, and why the last attempt failed."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from hoigs.core.errors import HoigsError
from hoigs.core.files.whole_files import write_whole
from hoigs.studies.batch.stages import Stage

STATE = "state.json"


@dataclass
class State:
    """`state.json` of a row's folder.

    Attributes:
        done: of each finished stage its command, seconds, device and host.
        begun: command of the stage that was started last, by its name.
        failed: stage, why, when (seconds since 1970); empty unless the last attempt failed.
        attempts: started stages by name, over all drivers.
    """

    done: dict[str, dict[str, Any]] = field(default_factory=dict)
    begun: dict[str, list[str]] = field(default_factory=dict)
    failed: dict[str, Any] = field(default_factory=dict)
    attempts: dict[str, int] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Of a row that was not started yet: empty.

        Raises:
            HoigsError: the file is damaged.
        """
        path = folder / STATE
        try:
            return cls(**json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError:
            return cls()
        except (ValueError, TypeError) as error:
            raise HoigsError(f"{path}: damaged ({error}); remove it to do the row again") from error

    @classmethod
    def known(cls, folder: Path) -> Self:
        """As `read`; a damaged record is a failure of its row."""
        try:
            return cls.read(folder)
        except HoigsError as error:
            return cls(failed={"stage": "", "why": str(error)})

    def write(self, folder: Path) -> None:
        write_whole(folder / STATE, json.dumps(asdict(self), indent=1))

    def todo(self, stages: Sequence[Stage]) -> Sequence[Stage]:
        """The first stage that is not done by its present command, and all after it."""
        for i, stage in enumerate(stages):
            record = self.done.get(stage.name)
            same = record is not None and record["command"] == list(stage.command)
            if not same or not stage.result.exists():
                return stages[i:]
        return ()

    def command(self, stage: Stage) -> tuple[str, ...]:
        """The command to run for a stage, by what lies on disk."""
        interrupted = self.begun.get(stage.name) == list(stage.command)
        checkpoints = stage.result / "checkpoints"
        if stage.resume and interrupted and any(checkpoints.glob("step_*.safetensors")):
            return stage.resume
        return stage.again if stage.again and stage.result.exists() else stage.command

    def begin(self, todo: Sequence[Stage]) -> None:
        """Note that the first of `todo` has started; what follows from it has to be done again."""
        stage = todo[0]
        self.begun[stage.name] = list(stage.command)
        self.attempts[stage.name] = self.attempts.get(stage.name, 0) + 1
        self.failed = {}
        for later in todo:
            self.done.pop(later.name, None)

    def end(self, stage: Stage, seconds: float, device: str, host: str) -> None:
        self.done[stage.name] = {
            "command": list(stage.command), "seconds": round(seconds, 3), "device": device,
            "host": host,
        }  # fmt: skip

    def fail(self, stage: Stage, why: str) -> None:
        self.failed = {"stage": stage.name, "why": why, "when": time.time()}
