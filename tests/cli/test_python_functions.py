"""Each command is one public function: the same options by the same names, the same defaults."""

from __future__ import annotations

import inspect
import pkgutil
from enum import Enum
from typing import Any

import pytest
import typer

import hoigs
from hoigs.cli.main import app

# command -> functions that it wraps; together they have every option
FUNCTIONS = {
    "train": (hoigs.train, hoigs.auto),
    "study needs": (hoigs.needs,),
    "eval": (hoigs.evaluate,),
    "prepare": (hoigs.prepare, hoigs.prepare_until),
    "refine": (hoigs.refine_poses,),
    "compress": (hoigs.compress,),
    "render": (hoigs.render,),
    "export": (hoigs.export,),
    "doctor": (hoigs.doctor,),
    "bug-report": (hoigs.bug_report,),
    "publish": (hoigs.publish,),
    "demo": (hoigs.demo,),
    "batch": (hoigs.batch,),
    "work": (hoigs.work,),
}
# option -> argument, where the names differ
RENAMED = {
    "set": "overrides",
    "plugin": "plugins",
    "reader_set": "reader_settings",
    "eval": "evaluate",
    "from": "start",
    "to": "end",
}
# options that choose the function: --auto is hoigs.auto, --stage is hoigs.prepare_until(stage, ...)
CHOOSING = {("train", "auto"), ("train", "smallest"), ("prepare", "stage")}
JSON = "json"  # --json is another way to print what a function returns
# arguments that only a Python caller can give: objects and callbacks
PYTHON = {"on_start", "on_step", "on_found", "progress", "report", "body", "estimators",
          "positions", "consent", "announce", "tick", "options", "preset", "file"}  # fmt: skip


def options_of(command: str) -> dict[str, Any]:
    """Argument name -> default of everything that a command takes."""
    parser: Any = typer.main.get_command(app)
    for name in command.split():
        parser = parser.commands[name]
    found = {}
    for parameter in parser.params:
        if parameter.name == "help":
            continue
        name = parameter.name
        if parameter.param_type_name == "option":
            name = parameter.opts[0].removeprefix("--").replace("-", "_")
        found[RENAMED.get(name, name)] = _plain(parameter.default)
    return found


def _plain(value: Any) -> Any:
    """Of equal meaning: nothing, () and None; a choice and its text; a path and its text."""
    if isinstance(value, Enum):
        return value.value
    if value in (None, (), []) or value is inspect.Parameter.empty:
        return None
    return value if isinstance(value, bool | int | float) else str(value)


@pytest.mark.parametrize("command", FUNCTIONS)
def test_a_function_has_every_option_of_its_command(command):
    options = options_of(command)
    for function in FUNCTIONS[command]:
        arguments = inspect.signature(function).parameters
        wanted = {k: v for k, v in options.items() if k != JSON and (command, k) not in CHOOSING}
        missing = set(wanted) - set(arguments)
        assert not missing, f"{function.__name__} is without {missing}"
        more = set(arguments) - set(options) - PYTHON
        assert not more, f"hoigs {command} is without {more}"
        for name in set(wanted) - PYTHON:
            found = _plain(arguments[name].default)
            assert found == wanted[name], f"{function.__name__}: {name}"


def test_no_public_name_is_hidden_by_a_module():
    """Importing hoigs.x would put the module in place of a function x."""
    assert not (set(hoigs.__all__) - set(hoigs._MODULES)) & {
        module.name for module in pkgutil.iter_modules(hoigs.__path__)
    }
