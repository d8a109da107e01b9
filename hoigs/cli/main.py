"""The `hoigs` command. Nothing here imports torch, so that `hoigs --help` answers at once."""

from __future__ import annotations

from typing import Any

import typer

from hoigs import __version__
from hoigs.cli import common, doctor, make, parts, see, study, train
from hoigs.cli.failures import GuardedGroup, failures_as_messages
from hoigs.cli.mistyped import COMMANDS, name_setting
from hoigs.core.errors import HoigsError
from hoigs.core.system.threads import keep_freed_memory, share_processors, short_waits_when_busy
from hoigs.plugins.builtin import PARTS as BUILT_IN

MAKE, TRAIN, SEE = "From a video to a clip", "From a clip to a run", "Look at it, take it away"
STUDY, PARTS, HELP = "Many runs", "Parts", "When something goes wrong"

SAID_ANYWHERE = {"-q", "--quiet", "-v", "--verbose"}
FORMATS = [(name.partition(":")[2], s) for name, *_, s in BUILT_IN if name.startswith("exporter:")]


class Root(GuardedGroup):
    """The command `hoigs`, whose -q and -v may also stand behind the verb."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ours = [word for word in args if word in SAID_ANYWHERE]
        return super().parse_args(ctx, ours + [w for w in args if w not in SAID_ANYWHERE])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands and args[0] in COMMANDS:
            raise HoigsError(f"{args[0]}: no such command; {COMMANDS[args[0]]}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Exception as error:
            name_setting(error)
            raise


app = typer.Typer(
    name="hoigs",
    cls=Root,
    help="People handling things, reconstructed from one video as moving 3D Gaussians.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
study_app = typer.Typer(no_args_is_help=True, help="Compare methods, and find their limits.")
study_app.command("compare")(study.compare)
study_app.command("stress")(study.stress)
study_app.command("needs")(train.needs)
app.command("demo", rich_help_panel=MAKE)(make.demo)
app.command("annotate", rich_help_panel=MAKE)(make.annotate)
app.command("prepare", rich_help_panel=MAKE)(make.prepare)
app.command("refine", rich_help_panel=MAKE)(make.refine)
app.command("train", rich_help_panel=TRAIN)(train.train)
app.command("eval", rich_help_panel=TRAIN)(train.evaluate)
app.command("render", rich_help_panel=SEE)(see.render)
app.command("view", rich_help_panel=SEE)(see.view)
app.command(
    "export",
    rich_help_panel=SEE,
    epilog="Formats:\n\n" + "\n".join(f"- `{name}`: {summary}" for name, summary in FORMATS),
)(see.export)
app.command("publish", rich_help_panel=SEE)(see.publish)
app.command("batch", rich_help_panel=STUDY)(study.batch)
app.command("work", rich_help_panel=STUDY)(study.work)
app.add_typer(study_app, name="study", rich_help_panel=STUDY)
app.command("compress", rich_help_panel=TRAIN)(train.compress)
app.add_typer(parts.plugins_app, name="plugins", rich_help_panel=PARTS)
app.add_typer(parts.spec_app, name="spec", rich_help_panel=PARTS)
app.add_typer(parts.estimators_app, name="estimators", rich_help_panel=PARTS)
app.command("doctor", rich_help_panel=HELP)(doctor.doctor)
app.command("bug-report", rich_help_panel=HELP)(doctor.bug_report)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"hoigs {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and stop."
    ),
    quiet: bool = typer.Option(
        False, "--quiet", "-q", help="Print results and warnings alone; also after the command."
    ),
    verbose: bool = typer.Option(
        False, "--verbose", "-v", help="Print every step of the work, and tracebacks of failures."
    ),
) -> None:
    common.Talk.quiet, common.Talk.verbose = quiet, verbose


def main() -> None:
    """Entry point: what goes wrong becomes one message on stderr and an exit code."""
    share_processors()
    keep_freed_memory()
    with short_waits_when_busy(), failures_as_messages():
        app()
