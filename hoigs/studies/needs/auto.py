"""auto: find what a clip needs of a spec, train that, then prune and compress the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.options import verb
from hoigs.core.reporting import Progress
from hoigs.core.spec.schema import Spec
from hoigs.core.system.files import named
from hoigs.core.system.random_state import callers_random_state
from hoigs.evaluation.evaluate_run import evaluate as evaluate_run
from hoigs.evaluation.options import EvaluateOptions
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import clip_name
from hoigs.runs.options import RunOptions
from hoigs.runs.resuming import DEFAULT_SPEC, NO_CLIP
from hoigs.runs.run_folder import RunFolder
from hoigs.studies.needs.after_training import After, add_to_answer, finish
from hoigs.studies.needs.compress import compact_of
from hoigs.studies.needs.needs import needs
from hoigs.studies.needs.options import NeedsOptions
from hoigs.studies.needs.result import Needs
from hoigs.training.options import TrainOptions
from hoigs.training.train import OnStart, OnStep, Report, TrainedRun, silent, train


@dataclass(frozen=True)
class AutoRun:
    """What `auto` made.

    Attributes:
        run: the pruned run and its scores; its session holds the model as it was before pruning.
        compact: folder of the compressed copy. answer: folder that `needs` wrote.
        needs: the search; None where the run was resumed. after: pruning and compression.
    """

    run: TrainedRun
    compact: Path
    answer: Path
    needs: Needs | None
    after: After


@verb(TrainOptions, "spec")
@callers_random_state()
def auto(
    clip: Path | str | None,
    *,
    options: TrainOptions,
    smallest: bool = False,
    on_found: Callable[[Needs], None] | None = None,
    on_start: OnStart | None = None,
    on_step: OnStep | None = None,
    progress: Progress | None = None,
    report: Report = silent,
) -> AutoRun:
    """Find how much of a spec a clip needs, train that, prune it, and compress it.

    The answer of `needs` is written to OUT-needs, the compressed copy to OUT-compact; OUT is by
    default runs/CLIP-SPEC-auto. With `resume` the training in OUT continues with the answer that it
    was started with. The reader is the one that recognises the clip, and there is no budget of
    time.

    Args:
        clip: a clip folder, or "builtin:NAME", of a layout that one reader alone recognises.
        smallest: search longer, for a model that is as small as can be; else it stays close to the
            whole spec's quality.
        on_found: called with the result of the search, before the training.
        on_start, on_step, progress, report: as for `train`.

    Raises:
        HoigsError: anything wrong with the input, or the run to resume was pruned already.
    """
    if clip is None:
        raise HoigsError(f"{NO_CLIP}; without --auto, --resume takes the run's own")
    if options.budget is not None:
        raise HoigsError("--auto has a budget of its own: leave --budget out")
    if options.reader or options.reader_settings:
        raise HoigsError(
            "--auto takes no --reader and no --reader-set: it chooses the reader of CLIP"
        )
    if isinstance(options.spec, Spec):
        raise HoigsError("--auto reduces a spec by its name or file, not a Spec")
    name = str(options.spec or DEFAULT_SPEC)
    own = Path("runs") / f"{clip_name(clip)}-{Path(name).stem}-auto"
    path = own if options.out is None else Path(options.out)
    answer, compact = needs_of(path), compact_of(path)
    device, plugins = pick_device(options.device), options.plugins
    trained = options.changed(spec=answer / "spec.yaml", out=path, device=device, evaluate=False)
    found: Needs | None = None
    if options.resume:
        _require_unfinished(path, answer)
    else:
        for folder in (path, compact):  # before the search, which may take hours
            RunFolder(folder).refuse_existing(options.overwrite, [clip], resumable=True)
        search = options.part(NeedsOptions).changed(
            spec=name, out=answer, device=device, overrides=options.spec_settings(),
            rasterizer=None, smallest=smallest,
        )  # fmt: skip
        found = needs(clip, options=search, report=report)
        trained = trained.changed(overrides=(), rasterizer=None, chunk=None)  # the answer has them
        if on_found is not None:
            on_found(found)
    run = train(clip, options=trained, on_start=on_start, on_step=on_step, report=report)
    report(f"pruning {path}:")
    trained_s = run.session.trainer.elapsed
    after = finish(
        path, compact, options=RunOptions(device=device, plugins=plugins),
        overwrite=options.overwrite,
        clock=(found.seconds, trained_s, found.full_seconds) if found else None,
        report=lambda line: report(f"  {line}"),
    )  # fmt: skip
    add_to_answer(after, answer)
    report(f"run: {path}, compressed: {compact}, reasons: {answer / 'needs.md'}")
    if options.evaluate:
        scored = evaluate_run(path, options=options.part(EvaluateOptions), progress=progress)
        report(f"report: {scored.report}")
        run = replace(run, evaluated=scored)
    return AutoRun(run, compact, answer, found, after)


def needs_of(run: Path) -> Path:
    """Folder of the `needs` answer that a run of `auto` is trained with."""
    run = named(run)
    return run.with_name(f"{run.name}-needs")


def _require_unfinished(path: Path, answer: Path) -> None:
    """HoigsError unless a run of `auto` was begun in `path` and is not pruned yet."""
    if not (answer / "spec.yaml").is_file():
        raise HoigsError(
            f"{answer / 'spec.yaml'}: not found, so no run of --auto was begun in {path}"
        )
    if RunFolder(path).provenance.is_file() and RunFolder(path).read_provenance().get("pruned"):
        raise HoigsError(f"{path}: is trained and pruned already; there is nothing to resume")
    RunFolder(path).refuse_existing(overwrite=True)  # pruning will replace it
