"""Stages of a row: one `hoigs` command each, with the path that it makes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hoigs.studies.batch.manifest import Row


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
    train = ("train", named, "--spec", row.spec, "--out", str(run), "--device", row.device,
             "--no-eval", *(["--auto"] if row.auto else []), *_each("--set", row.set))  # fmt: skip
    stages.append(
        Stage("train", train, run, run, again=(*train, "--overwrite"), resume=(*train, "--resume"))
    )
    device = ("--device", row.device)
    stages.append(Stage("eval", ("eval", str(run), *device), run / "evaluation.json", run))
    for format in row.export:
        target = folder / "exports" / format
        export = ("export", str(run), "--format", format, "--out", str(target), *device)
        stages.append(Stage(f"export-{format}", export, target, target, clear=True))
    if row.publish:
        only = _each("--only", ("run", "exports") if row.export else ("run",))
        command = ("publish", str(folder), f"{row.publish.rstrip('/')}/{row.name}", *only)
        stages.append(Stage("publish", command, run, run))
    return stages


def _each(option: str, values: tuple[str, ...]) -> list[str]:
    return [word for value in values for word in (option, value)]
