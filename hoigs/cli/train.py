"""`hoigs train`: a clip and a spec in, a run folder out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hoigs.cli.common import (
    DeviceOption,
    PluginOption,
    RasterizerOption,
    SetOption,
    overrides,
    pick_device,
    print_table,
    progress_bar,
)

if TYPE_CHECKING:
    from hoigs.studies.needs.search import Needs
    from hoigs.training.session import Session


def train(
    clip: Annotated[
        Path | None,
        typer.Argument(
            help="Clip folder, as `hoigs prepare` makes it, or builtin:NAME. Default with "
            "--resume: the run's."
        ),
    ] = None,
    spec: Annotated[
        str | None,
        typer.Option(
            "--spec",
            help="A built-in spec's name or a file; @PROFILE may follow. Default hoigs; with "
            "--resume the run's.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Run folder; default runs/CLIP-SPEC.")
    ] = None,
    settings: SetOption = None,
    rasterizer: RasterizerOption = None,
    device: DeviceOption = "auto",
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the run in --out, by its own spec and clip."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the run in --out.")
    ] = False,
    allow_faults: Annotated[
        bool,
        typer.Option(
            "--allow-faults",
            help="Go on without masks, images and depth that are absent or broken.",
        ),
    ] = False,
    reader: Annotated[
        str | None,
        typer.Option("--reader", help="Data set layout of CLIP; default: the one it looks like."),
    ] = None,
    reader_set: Annotated[
        list[str] | None,
        typer.Option("--reader-set", help="A setting of the reader: masks=false. Repeatable."),
    ] = None,
    auto: Annotated[
        bool,
        typer.Option(
            "--auto",
            help="First find how much of the spec this clip needs (`hoigs needs`); prune and "
            "compress what has been trained.",
        ),
    ] = False,
    evaluate: Annotated[
        bool, typer.Option("--eval/--no-eval", help="Score the run and write its report.")
    ] = True,
    plugin: PluginOption = None,
) -> None:
    """Fit a model to a clip; then score it and write report.html."""
    from hoigs.cli.evaluate import score_run
    from hoigs.core.errors import HoigsError
    from hoigs.training.clip_source import clip_name
    from hoigs.training.resuming import DEFAULT_SPEC, NO_CLIP
    from hoigs.training.session import Session

    where = pick_device(device)
    given = overrides(settings, rasterizer)
    found: Needs | None = None
    if auto:
        if clip is None:
            raise HoigsError(f"{NO_CLIP}; without --auto, --resume takes the run's own")
        asked = spec or DEFAULT_SPEC
        out = out or Path("runs") / f"{clip_name(clip)}-{Path(asked).stem}-auto"
        spec, given, found = _needed(
            clip, asked, out, given, where, overwrite, resume, allow_faults,
            [reader, reader_set], plugin or (),
        )  # fmt: skip
    session = Session.open(
        clip,
        spec,
        out=out,
        overrides=given,
        device=where,
        resume=resume,
        overwrite=overwrite,
        plugins=plugin or (),
        allow_faults=allow_faults,
        reader=reader,
        reader_settings=reader_set or (),
    )
    run_session(session)
    if auto:
        _finish(session, found, where, overwrite, plugin or ())
    if evaluate:
        score_run(session.run.path, device=where, plugins=plugin or ())


def _needed(
    clip: Path,
    spec: str,
    out: Path,
    given: Sequence[str],
    device: str,
    overwrite: bool,
    resume: bool,
    allow_faults: bool,
    of_reader: Sequence[object],
    plugins: Sequence[Path],
) -> tuple[str, list[str], Needs | None]:
    """The spec that `--auto` trains, found beside the run folder, what is left to lay over it, and
    the search.

    A run that goes on takes the answer that it was begun with.
    """
    from hoigs.cli.needs import find_needs
    from hoigs.core.errors import HoigsError
    from hoigs.training.run_folder import RunFolder

    if any(of_reader):
        raise HoigsError(
            "--auto cannot be told a reader; let CLIP be read by the one it looks like"
        )
    folder = out.with_name(f"{out.name}-needs")
    answer = str(folder / "spec.yaml")
    if resume:
        if not Path(answer).is_file():
            raise HoigsError(f"{answer}: not there, so no run of --auto was begun in {out}")
        if RunFolder(out).provenance.is_file() and RunFolder(out).read_provenance().get("pruned"):
            raise HoigsError(f"{out}: is trained and pruned; nothing is left to go on with")
        return answer, list(given), None
    RunFolder(out).refuse_existing(overwrite)
    RunFolder(compact_of(out)).refuse_existing(overwrite)
    found = find_needs(
        clip,
        spec,
        folder,
        given=given,
        device=device,
        overwrite=overwrite,
        allow_faults=allow_faults,
        plugins=plugins,
    )
    return answer, [], found


def compact_of(run: Path) -> Path:
    """Where the compact twin of a run of `--auto` stands."""
    return run.with_name(f"{run.name}-compact")


def _finish(
    session: Session,
    found: Needs | None,
    device: str,
    overwrite: bool,
    plugins: Sequence[Path],
) -> None:
    """Prune the trained run, write its compact twin, and put both into the answer's table."""
    from hoigs.studies.needs.after import add_to_answer, finish, sentences, table

    out = session.run.path
    clock = None if found is None else (found.seconds, session.trainer.elapsed, found.full_seconds)
    typer.echo(f"pruning {out}:")
    after = finish(
        out, compact_of(out), device=device, plugins=plugins, overwrite=overwrite, clock=clock,
        report=lambda line: typer.echo(f"  {line}"),
    )  # fmt: skip
    columns, rows = table(after)
    print_table("after the training", columns, rows)
    for sentence in sentences(after):
        typer.echo(sentence)
    answer = out.with_name(f"{out.name}-needs")
    add_to_answer(after, answer)
    typer.echo(f"run: {out}, in few bytes {compact_of(out)}; why: {answer / 'needs.md'}")


def run_session(session: object) -> None:
    """Train with a progress bar; a line a thousand steps where stderr is not a terminal."""
    from hoigs.training.session import Session
    from hoigs.training.trainer import StepReport

    assert isinstance(session, Session)
    steps, width = session.spec.train.steps, session.spec.train.width
    own = session.clip.cameras[0].width
    if width is not None and own < width:
        typer.echo(f"train.width={width} is wider than the clip: its {own} pixels are kept")
    typer.echo(
        f"training {session.spec.name} on {session.clip.name} ({session.reader}): {steps} steps, "
        f"{len(session.clip.split['train'])} frames of "
        f"{session.clip.cameras[0].width}x{session.clip.cameras[0].height}"
    )
    for change in session.changes:
        typer.echo(f"changed on resuming: {change}")
    for fault in session.faults:
        typer.echo(f"warning: {fault}", err=True)
    latest: dict[str, float] = {}
    with progress_bar("training", steps) as bar:

        def on_step(report: StepReport) -> None:
            latest.update(report.psnr)
            score = f" test {latest['test']:.2f} dB" if "test" in latest else ""
            splats = sum(report.counts.values())
            bar.update(report.step, f"loss {report.loss:.4f}{score} {splats} splats")
            if report.psnr:
                rest = (steps - report.step) * report.time_s / report.step
                typer.echo(
                    f"step {report.step:>6}  {report.time_s:7.1f} s  ETA {rest:6.0f} s  "
                    f"loss {report.loss:.4f} {score}  {splats} splats"
                )

        session.train(on_step)
    for step, culprit in session.trainer.guard.skipped[:5]:
        typer.echo(f"skipped step {step}: {culprit} was not finite")
    typer.echo(f"run: {session.run.path}")
