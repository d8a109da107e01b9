"""State of a row on disk: which stages are done, and why the last attempt failed."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.files.json_file import parse_json, problems_of
from hoigs.core.files.whole_files import write_whole
from hoigs.studies.batch.stages import Stage

STATE = "state.json"


@dataclass
class Done:
    """A finished stage."""

    command: list[str]
    seconds: float
    device: str
    host: str


@dataclass
class Failed:
    """Why the last attempt failed; `when` in seconds since 1970. Empty unless it did."""

    stage: str = ""
    why: str = ""
    when: float = 0.0


@dataclass
class State:
    """`state.json` of a row's folder.

    Attributes:
        done: each finished stage by its name.
        begun: command of the stage that was started last, by its name.
        failed: of the last attempt.
        attempts: started stages by name, over all drivers.
    """

    done: dict[str, Done] = field(default_factory=dict)
    begun: dict[str, list[str]] = field(default_factory=dict)
    failed: Failed = field(default_factory=Failed)
    attempts: dict[str, int] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> State:
        """Of a row that was not started yet: empty.

        Raises:
            HoigsError: the file is damaged.
        """
        path = folder / STATE
        try:
            return _STATE.validate_python(parse_json(path))
        except FileNotFoundError:
            return cls()
        except ValueError as error:  # pydantic's too
            why = problems_of(error) if isinstance(error, ValidationError) else error
            raise HoigsError(f"{path}: damaged ({why}); remove it to do the row again") from error

    @classmethod
    def known(cls, folder: Path) -> State:
        """As `read`; a damaged record is a failure of its row."""
        try:
            return cls.read(folder)
        except HoigsError as error:
            return cls(failed=Failed(why=str(error)))

    def write(self, folder: Path) -> None:
        write_whole(folder / STATE, json.dumps(asdict(self), indent=1))

    def todo(self, stages: Sequence[Stage]) -> Sequence[Stage]:
        """The first stage that is not done by its present command, and all after it."""
        for i, stage in enumerate(stages):
            record = self.done.get(stage.name)
            same = record is not None and record.command == list(stage.command)
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
        self.failed = Failed()
        for later in todo:
            self.done.pop(later.name, None)

    def end(self, stage: Stage, seconds: float, device: str, host: str) -> None:
        self.done[stage.name] = Done(list(stage.command), round(seconds, 3), device, host)

    def fail(self, stage: Stage, why: str) -> None:
        self.failed = Failed(stage.name, why, time.time())


_STATE = TypeAdapter(State)
