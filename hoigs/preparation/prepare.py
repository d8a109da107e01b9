"""prepare: a video and what is known of it in, a clip folder with a written report out."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import ValidationError

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.clip_folder.format import is_clip_folder
from hoigs.core.clip_folder.write import refuse_to_overwrite
from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.options import verb
from hoigs.core.registry.registry import default_registry
from hoigs.core.reporting import Progress, default_progress
from hoigs.core.system.files import named
from hoigs.core.system.random_state import callers_random_state
from hoigs.core.system.threads import short_waits_when_busy
from hoigs.core.system.urls import local_path
from hoigs.core.system.video_files import pyav
from hoigs.preparation import stages
from hoigs.preparation.body.body_files import BodyFileEstimator, body_beside
from hoigs.preparation.clip_writing import Cleanup
from hoigs.preparation.draft import Draft
from hoigs.preparation.estimates.installed import installed_estimators, refuse_commands
from hoigs.preparation.estimates.plan import (
    Consent,
    EstimatorPlan,
    agree,
    get_ready,
    plan_estimators,
)
from hoigs.preparation.estimates.reader import Estimators
from hoigs.preparation.kept import PLAN, check_stage, with_dependents
from hoigs.preparation.options import PrepareOptions, Preset
from hoigs.preparation.prompts import with_prompts, with_stored
from hoigs.preparation.report.report import PrepareReport
from hoigs.preparation.video.source import SourceError, find_source, find_video
from hoigs.preparation.work_folder import WorkFolder

__all__ = ["PrepareOptions", "PrepareReport", "prepare", "prepare_until", "work_folder"]


def work_folder(out: str | Path) -> Path:
    """Where the stages of the clip `out` keep their results: `out`.prepare, beside it."""
    out = Path(out).absolute()
    out = named(out)
    return out.with_name(out.name + ".prepare")


@verb(PrepareOptions)
def prepare(
    source: str | Path,
    out: str | Path,
    *,
    options: PrepareOptions,
    body: BodyModel | None = None,
    estimators: Estimators | Preset | None = None,
    consent: Consent | None = None,
    announce: Callable[[EstimatorPlan], builtins.object] | None = None,
    progress: Progress | None = None,
) -> PrepareReport:
    """Turn a source into a clip folder, stage by stage.

    Each stage keeps its result in `work_folder(out)`, under what it was made from; a later run
    takes up the stages whose source and options are the same, so that a run that was stopped, or
    killed, goes on where it was. That folder may be removed at any time.

    Args:
        source: a folder with a video or frames and their estimators (see `find_source`), or the
            video in it; or the URL of either (`hoigs.core.storage`).
        out: the clip folder to make, with report.json, report.md and overlay.mp4 in it; it
            appears when it is whole.
        body: the model to fit, whose key is `options.body`; by default it is made from that key.
        estimators: by kind of estimate, "masks", "landmarks", "object" or "depth"; those of
            `options.estimators`, which are looked up among the installed plugins, come second.
            Or a preset, in place of `options.preset`.
        consent: called with a question before anything is installed or downloaded, where `yes`
            does not answer it; None: nothing is downloaded.
        announce: called with the plan before work begins; and, where several people are seen, with
            one of notes alone that say who is followed, before they are.
        progress: called with the done fraction, 0 to 1, and the stage's name.

    Raises:
        SpecError: options are wrong, or `options.estimators` would run programs, and may not.
        SourceError: an input is absent, unreadable or does not fit the others.
        ClipError: `out` is there already, or another process is preparing it.
        HoigsError: there is no stage of a name in `redo`.
    """
    talk = _Talk(consent, announce, progress or default_progress())
    return _run((Path(source), Path(out)), options, body, estimators, talk).report


@verb(PrepareOptions)
def prepare_until(
    stage: str,
    source: str | Path,
    out: str | Path,
    *,
    options: PrepareOptions,
    body: BodyModel | None = None,
    estimators: Estimators | Preset | None = None,
    consent: Consent | None = None,
    announce: Callable[[EstimatorPlan], builtins.object] | None = None,
    progress: Progress | None = None,
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
    talk = _Talk(consent, announce, progress or default_progress())
    return _run((Path(source), Path(out)), options, body, estimators, talk, stage).seconds


@dataclass(frozen=True)
class _Talk:
    """The caller's callbacks."""

    consent: Consent | None
    announce: Callable[[EstimatorPlan], object] | None
    progress: Progress


@short_waits_when_busy()
@callers_random_state()
def _run(
    paths: tuple[Path, Path],
    options: PrepareOptions,
    body: BodyModel | None,
    estimators: Estimators | Preset | None,
    talk: _Talk,
    until: str | None = None,
) -> Draft:
    pyav()  # without it the report's video would be missed at the end
    if isinstance(estimators, str):
        options = options.changed(preset=estimators)
    options = with_prompts(options)
    source, out = local_path(paths[0]), paths[1]
    for name in options.redo:
        check_stage(name)
    _check_paths(source, out, options.overwrite or bool(options.redo) or until is not None)
    options, stored = with_stored(options, find_video(source))
    named = installed_estimators(options.estimators, options.document)
    if not options.allow_commands:
        refuse_commands(named)  # `estimators` are the caller's own code
    own = {} if isinstance(estimators, str) else (estimators or {})
    chosen = {**named, **own}
    bodies = body_beside(source, options.bodies)
    if bodies is not None and len(options.people) != 1:
        stored += (f"{bodies.path.name} is not used: it is of one person",)
        bodies = None
    if bodies is not None and bodies.gives_landmarks(chosen, options.bodies is not None):
        body = body or _body(options.body)
        chosen["landmarks"] = BodyFileEstimator(bodies.path, body)
    found = find_source(
        source, people=options.people, object_name=options.object_name, given=set(chosen),
        own_cameras=options.own_cameras,
        complete=options.preset == "files",
    )  # fmt: skip
    plan = replace(plan_estimators(found, options, set(chosen)), notes=stored)
    if bodies is not None:
        plan = plan.with_body(bodies, chosen.get("landmarks"))
        if not isinstance(chosen.get("landmarks"), BodyFileEstimator):
            bodies = None  # tried: its rotations make a fit to landmarks no better
    specs = plan.specs()
    for kind, spec in found.beside.items():
        specs[kind] = spec
    chosen = {**installed_estimators(specs), **chosen}
    if talk.announce is not None:
        talk.announce(plan)
    get_ready(plan, chosen, agree if options.yes else talk.consent, talk.progress)
    body = body or _body(options.body)
    with WorkFolder(work_folder(out)) as work:
        Cleanup(out.absolute(), work.root).remove()
        for name in with_dependents(options.redo):
            work.forget(name)
        draft = Draft(
            found, out, body, work, bodies,
            lambda said: talk.announce and talk.announce(EstimatorPlan({}, notes=(said,))),
        )  # fmt: skip
        try:
            return stages.run(draft, options, chosen, talk.progress, until)
        except HoigsError:
            if work.new and not work.worth_keeping:
                work.discard()
            raise


def _body(key: str) -> BodyModel:
    """The installed body model of a key, with its default settings.

    Raises:
        HoigsError: no body model has this key, or it has no defaults: its files have to be named.
    """
    registry = default_registry()
    component, config_class = registry.concrete(key), registry.config_class(key)
    try:
        config = config_class()
    except ValidationError as error:
        needed = ", ".join(str(wrong["loc"][0]) for wrong in error.errors())
        raise HoigsError(
            f"body {key}: has no default for {needed}; make the model and call "
            "hoigs.prepare(..., body=model)"
        ) from error
    made: BodyModel = component.from_config(config, BuildContext())
    return made


def _check_paths(source: Path, out: Path, replace: bool) -> None:
    if source.is_dir() and is_clip_folder(source):
        problems = len(check_clip(source))
        state = f"with {problems} problems" if problems else "and whole: train on it"
        raise SourceError(f"{source} is a clip already, {state}")
    if is_clip_folder(out) and not replace:
        raise ClipError(f"{out} holds a clip already; choose another name or pass --overwrite")
    refuse_to_overwrite(out, [source])
