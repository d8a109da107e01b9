"""What somebody means who types a command or an option that hoigs does not have."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

# words that other programs have, or that the documentation uses, and the command for each
COMMANDS = {
    "film": "`hoigs render RUN` makes a film",
    "video": "`hoigs render RUN` makes a film",
    "play": "`hoigs view RUN` plays it in the browser",
    "show": "`hoigs view RUN` shows it in the browser",
    "player": "`hoigs view RUN --html page.html` writes a player in one file",
    "click": "`hoigs annotate VIDEO` opens a page to click in",
    "report": "`hoigs prepare` writes report.html into the clip, `hoigs eval` into the run",
    "score": "`hoigs eval RUN` scores a run",
    "fit": "`hoigs train CLIP` fits a model to a clip",
    "reconstruct": "`hoigs prepare VIDEO --out CLIP`, then `hoigs train CLIP`",
    "run": "`hoigs prepare VIDEO --out CLIP`, then `hoigs train CLIP`",
    "convert": "`hoigs export RUN` writes the files of another program",
    "install": "`hoigs estimators install NAME` installs an estimator",
}


def settings_of(command: str) -> dict[str, str]:
    """Settings of a command that are no options of it, by their last name: what --set takes."""
    if command == "train":
        from hoigs.core.spec.train_schema import TrainSpec

        return {name: f"train.{name}" for name in TrainSpec.model_fields}
    if command == "prepare":
        from hoigs.preparation.options import PrepareOptions

        return {name: name for name in PrepareOptions.model_fields}
    return {}


def name_setting(error: Any) -> None:
    """Let a click error about an unknown option name the setting that is meant, if one is."""
    option, context = str(getattr(error, "option_name", "")), getattr(error, "ctx", None)
    if type(error).__name__ != "NoSuchOption" or context is None:
        return
    word = option.removeprefix("--").replace("-", "_")
    own = [name.removeprefix("--").replace("-", "_") for name in _options(context.command)]
    settings = {n: s for n, s in settings_of(context.command.name).items() if n not in own}
    near = difflib.get_close_matches(word, [*own, *settings], n=1, cutoff=0.7)
    if near and near[0] in settings:
        error.message += f"; a setting has no option of its own: --set {settings[near[0]]}=VALUE"
        error.possibilities = None


def _options(command: Any) -> Iterable[str]:
    return (name for parameter in command.params for name in parameter.opts)
