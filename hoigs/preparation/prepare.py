"""prepare: a video and what is known of it in, a clip folder with a written report out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hoigs.core.body import BodyModel
from hoigs.core.clip_folder import check_clip, refuse_to_overwrite
from hoigs.core.clip_format import is_clip_folder
from hoigs.core.errors import ClipError, HoigsError
from hoigs.preparation.evidence import Priors
from hoigs.preparation.leftovers import Leftovers
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.pipeline import Pipeline
from hoigs.preparation.plan import PLAN, and_after, check_stage
from hoigs.preparation.report import PrepareReport
from hoigs.preparation.settings import installed_priors, refuse_commands
from hoigs.preparation.source import SourceError, find_source
from hoigs.preparation.stages import Progress, Stages
from hoigs.preparation.store import WorkFolder

__all__ = ["PrepareOptions", "PrepareReport", "prepare", "prepare_until", "work_folder"]


def work_folder(out: str | Path) -> Path:
    """Where the stages of the clip `out` keep their results: `out`.prepare, beside it."""
    out = Path(out).absolute()
    return out.with_name(out.name + ".prepare")


def prepare(
    source: str | Path,
    out: str | Path,
    *,
    body: BodyModel,
    options: PrepareOptions | None = None,
    progress: Progress | None = None,
    redo: Sequence[str] = (),
    priors: Priors | None = None,
    allow_commands: bool = False,
) -> PrepareReport:
    """Turn a source into a clip folder, stage by stage.

    Each stage keeps its result in `work_folder(out)`, under what it was made from; a later run
    takes up the stages whose source and options are the same, so that a run that was stopped, or
    killed, goes on where it was. That folder may be removed at any time.

    Args:
        source: a folder with a video or frames and their priors (see `find_source`), or the video
            in it.
        out: the clip folder to make, with report.json, report.md and overlay.mp4 in it; it
            appears when it is whole.
        body: the model to fit; `options.body` is its key.
        progress: called with 0..1 and the stage's name.
        redo: stages to run anew, with all that build on them; an older clip is then replaced.
        priors: by kind of evidence, "masks", "landmarks" or "depth"; those of `options.priors`,
            which are looked up among the installed plugins, come second.
        allow_commands: let `options.priors` run the programs that they name.

    Raises:
        SpecError: `options.priors` would run programs, and may not.
        SourceError: an input is absent, unreadable or does not fit the others.
        ClipError: `out` is there already, or another process is preparing it.
        HoigsError: there is no stage of a name in `redo`.
    """
    options = options or PrepareOptions()
    replace = options.overwrite or bool(redo)
    run = _run(
        source, out, body, options, progress, redo, priors, None, replace, allow_commands
    )  # fmt: skip
    return run.report


def prepare_until(
    stage: str,
    source: str | Path,
    out: str | Path,
    *,
    body: BodyModel,
    options: PrepareOptions | None = None,
    progress: Progress | None = None,
    redo: Sequence[str] = (),
    priors: Priors | None = None,
    allow_commands: bool = False,
) -> dict[str, float]:
    """As `prepare`, but only up to and including `stage`; no clip is written.

    Returns:
        seconds that each stage took, now or when its result was made.

    Raises:
        HoigsError: there is no such stage, or it is the last, which is `prepare`; and as `prepare`.
    """
    check_stage(stage)
    if stage == list(PLAN)[-1]:
        raise HoigsError(f"{stage} is the last stage: run prepare as a whole")
    options = options or PrepareOptions()
    run = _run(source, out, body, options, progress, redo, priors, stage, True, allow_commands)
    return run.stages.seconds


def _run(
    source: str | Path,
    out: str | Path,
    body: BodyModel,
    options: PrepareOptions,
    progress: Progress | None,
    redo: Sequence[str],
    priors: Priors | None,
    until: str | None,
    replace: bool,
    allow_commands: bool,
) -> Pipeline:
    source, out = Path(source), Path(out)
    for name in redo:
        check_stage(name)
    _check_paths(source, out, replace)
    named = installed_priors(options)
    if not allow_commands:
        refuse_commands(named)  # `priors` are the caller's own code
    chosen = {**named, **(priors or {})}
    found = find_source(
        source, human=options.human, object_name=options.object, given=set(chosen),
        own_cameras=options.camera in ("static", "sfm"),
    )  # fmt: skip
    chosen = {**installed_priors(PrepareOptions(priors=found.beside)), **chosen}
    stages = Stages({name: stage.weight for name, stage in PLAN.items()}, progress)
    with WorkFolder(work_folder(out)) as work:
        leftovers = Leftovers(out.absolute(), work.root)
        leftovers.remove()
        for name in and_after(redo):
            work.forget(name)
        pipeline = Pipeline(found, out, body, options, chosen, stages, work, leftovers)
        try:
            pipeline.run(until)
        except HoigsError:
            if work.new and not pipeline.worth_keeping:
                work.discard()
            raise
    return pipeline


def _check_paths(source: Path, out: Path, replace: bool) -> None:
    if source.is_dir() and is_clip_folder(source):
        problems = len(check_clip(source))
        state = f"with {problems} problems" if problems else "and whole: train on it"
        raise SourceError(f"{source} is a clip already, {state}")
    refuse_to_overwrite(out)
    if is_clip_folder(out) and not replace:
        raise ClipError(f"{out} holds a clip already; choose another name or pass --overwrite")
