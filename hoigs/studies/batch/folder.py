"""BatchFolder: the folder of a batch on disk, with its rows and the folders of these."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.system.files import (
    json_value,
    parse_json,
    problems_of,
    regular_file,
    write_whole,
    written_whole,
)
from hoigs.evaluation.options import EvaluateOptions
from hoigs.studies.batch.manifest import Row
from hoigs.studies.execution.queue import TakenError, hold
from hoigs.viewing.options import ExportOptions

BATCH = "batch.jsonl"
MANY = 10_000  # rows, from which on they lie in 256 folders: network disks list large ones slowly
HALVES = [f"{i:02x}" for i in range(256)]
TURN_POLL_S = 0.2


@dataclass(frozen=True)
class BatchFolder:
    """The folder that `hoigs batch` was given as --out.

    Attributes:
        fan_out: whether a row's folder is rows/xx/NAME, with a hash of its name, or rows/NAME. It
            is decided when the batch is begun, and stays.
    """

    path: Path
    fan_out: bool = False

    def of(self, row: Row) -> Path:
        return self.path / self.relative(row)

    def relative(self, row: Row) -> str:
        """The folder of a row, from the batch's."""
        if not self.fan_out:
            return f"rows/{row.name}"
        return f"rows/{hashlib.sha256(row.name.encode()).hexdigest()[:2]}/{row.name}"

    def rows(self) -> Iterator[Row]:
        """All rows of the batch, read one by one.

        Raises:
            HoigsError: the list is damaged.
        """
        with regular_file(self.path / BATCH).open(encoding="utf-8") as file:
            next(file)
            for number, line in enumerate(file, 2):
                try:
                    yield Row.model_validate_json(line)
                except ValueError as error:
                    raise _damaged(self.path / BATCH, number) from error

    @classmethod
    def begin(cls, path: Path, rows: Iterable[Row], many: int = MANY) -> BatchFolder:
        """Make the folder, or bring the rows of an existing one up to date.

        Args:
            rows: checked as they come; if one cannot be used, the folder stays as it was.
            many: rows from which on a new batch has `fan_out`.

        Raises:
            HoigsError: `path` is a file; or as `rows` raises.
        """
        if path.exists() and not path.is_dir():
            raise HoigsError(f"{path}: is a file; --out names a folder")
        first = next(rows := iter(rows), None)  # a wrong one raises before a folder is made
        path.mkdir(parents=True, exist_ok=True)
        with in_turn(path / BATCH), written_whole(path / BATCH) as part:
            known, count = cls._known(path), 0
            with part.open("w", encoding="utf-8") as file:
                file.write(_head(False))
                for row in chain([first] if first else [], rows):
                    file.write(f"{row.model_dump_json()}\n")
                    count += 1
                fan_out = count >= many if known is None else known
                file.seek(0)
                file.write(_head(fan_out))
        made = cls(path, fan_out)
        for half in HALVES if fan_out else [""]:
            (path / "rows" / half).mkdir(parents=True, exist_ok=True)
        return made

    @classmethod
    def _known(cls, path: Path) -> bool | None:
        """The `fan_out` of a batch that is there, by its folders where its list is damaged; None:
        there is no batch."""
        if not (path / BATCH).exists():
            return None
        try:
            return cls.open(path).fan_out
        except HoigsError:
            return all((path / "rows" / half).is_dir() for half in HALVES)

    @classmethod
    def open(cls, path: Path) -> BatchFolder:
        """A batch that was begun.

        Raises:
            HoigsError: there is none, or its list of rows is damaged.
        """
        try:
            with regular_file(path / BATCH).open(encoding="utf-8") as file:
                return cls(path, bool(json_value(file.readline())["fan_out"]))
        except FileNotFoundError:
            raise HoigsError(
                f"{path}: no batch; `hoigs batch MANIFEST --out {path}` begins one"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise _damaged(path / BATCH, 1) from error


@contextmanager
def in_turn(path: Path) -> Iterator[None]:
    """Wait until no other driver writes this file, and keep them from it."""
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(hold(path, "hoigs batch"))
                break
            except TakenError:
                time.sleep(TURN_POLL_S)
        yield


def _head(fan_out: bool) -> str:
    """The first line, always as long."""
    return json.dumps({"fan_out": fan_out}).ljust(20) + "\n"


def _damaged(path: Path, line: int) -> HoigsError:
    return HoigsError(f"{path}:{line}: damaged; `hoigs batch` writes it again")


# Stages of a row: one `hoigs` command each, with the path that it makes.


@dataclass(frozen=True)
class Stage:
    """A command of a row.

    Attributes:
        name: as in the log's name. command: arguments of `hoigs`. result: what it makes.
        locks: the folder whose lock the command takes.
        again: replaces `command` where the result, or a part of it, exists already.
        resume: replaces `command` where this very command was interrupted after a checkpoint.
        clear: whether an existing result is removed first, as the command replaces none.
    """

    name: str
    command: tuple[str, ...]
    result: Path
    locks: Path
    again: tuple[str, ...] = ()
    resume: tuple[str, ...] = ()
    clear: bool = False


def stages_of(row: Row, folder: Path) -> list[Stage]:
    """The stages of `row` in order, all of them below its folder."""
    run, clip = folder / "run", Path(row.clip)
    stages = []
    if row.video:
        clip = folder / "clip"
        work = clip.with_name("clip.prepare")  # `preparation.prepare.work_folder`, without torch
        prepare = ("prepare", row.video, "--out", str(clip), "--yes",
                   *_each("--set", row.prepare), *_each("--object", row.object))  # fmt: skip
        stages.append(Stage("prepare", prepare, clip, work, again=(*prepare, "--overwrite")))
    named = row.clip or str(clip)
    train = ("train", named, *row.training(run).words(), *(["--auto"] if row.auto else []))
    again, resume = (*train, "--overwrite"), (*train, "--resume")
    stages.append(Stage("train", train, run, run, again=again, resume=resume))
    evaluate = ("eval", str(run), *EvaluateOptions(device=row.device).words())
    stages.append(Stage("eval", evaluate, run / "evaluation.json", run))
    for format in row.export:
        target = folder / "exports" / format
        options = ExportOptions(format=format, out=target, device=row.device)
        export = ("export", str(run), *options.words())
        stages.append(Stage(f"export-{format}", export, target, target, clear=True))
    if row.publish:
        only = _each("--only", ("run", "exports") if row.export else ("run",))
        command = ("publish", str(folder), f"{row.publish.rstrip('/')}/{row.name}", *only)
        stages.append(Stage("publish", command, run, run))
    return stages


def _each(option: str, values: tuple[str, ...]) -> list[str]:
    return [word for value in values for word in (option, value)]


# State of a row on disk: which stages are done, and why the last attempt failed.

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
        """The state of a row; an empty one if the row was not started yet.

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
