"""Options of a verb: one declaration for Python and the command line."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from pydantic import Field
from typer.testing import CliRunner

from hoigs.cli.options import flags
from hoigs.core.errors import HoigsError
from hoigs.core.options import Flag, Options, verb


class BakeOptions(Options):
    """A verb's."""

    oven: str = "stone"
    """Where."""
    minutes: Annotated[int, Field(ge=1)] | None = None
    """How long, in the --oven."""
    toppings: Annotated[tuple[str, ...], Flag("--with")] = ()
    """What is on it."""
    serve: Annotated[bool, Flag("--serve/--no-serve")] = True
    """Bring it."""
    out: Path | str | None = None
    """Where to."""


@verb(BakeOptions, "oven")
def bake(dough: str, *, options: BakeOptions, report: Any = None) -> tuple[str, BakeOptions, Any]:
    """Bake.

    Args:
        dough: of what.

    Raises:
        HoigsError: never.
    """
    return dough, options, report


def test_keywords_place_and_object_are_one():
    assert bake("rye") == ("rye", BakeOptions(), None)
    assert bake("rye", "gas", minutes=3, report=print)[1:] == (
        BakeOptions(oven="gas", minutes=3), print,
    )  # fmt: skip
    given = BakeOptions(oven="gas", toppings=("nuts",))
    assert bake("rye", options=given, minutes=3)[1] == given.changed(minutes=3)
    assert bake("rye", toppings=["nuts"])[1].toppings == ("nuts",)
    with pytest.raises(TypeError):
        bake("rye", "gas", oven="wood")
    with pytest.raises(TypeError):
        bake("rye", "gas", "more")


@pytest.mark.parametrize(
    ("wrong", "facts"),
    [
        ({"minuts": 3}, ("bake", "minuts", "minutes")),
        ({"minutes": 0}, ("bake", "minutes", "1", "0")),
        ({"toppings": "nuts"}, ("bake", "toppings", "nuts")),
        ({"options": {"oven": "gas"}}, ("bake", "BakeOptions", "dict")),
    ],
)
def test_what_does_not_fit_is_named(wrong, facts):
    with pytest.raises(HoigsError) as error:
        bake("rye", **wrong)
    assert all(fact in str(error.value) for fact in facts)


def test_signature_and_docstring_have_every_option():
    shown = inspect.signature(bake).parameters
    assert list(shown) == ["dough", *BakeOptions.model_fields, "report", "options"]
    assert shown["oven"].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    text = inspect.getdoc(bake)
    assert text.index("dough:") < text.index("minutes: How long, in the `oven`") < text.index("Rai")


def test_a_record_has_what_was_changed():
    options = BakeOptions(oven="stone", toppings=("nuts",), out=Path("a/b"))
    assert options.record() == {"toppings": ["nuts"], "out": "a/b"}
    assert options.record("out") == {"toppings": ["nuts"]}


def test_the_command_line_has_the_same_options():
    app, got = typer.Typer(), []

    @app.command()
    @flags(BakeOptions)
    def command(dough: str, options: BakeOptions) -> None:
        got.append((dough, options))

    line = ["rye", "--with", "nuts", "--with", "figs", "--no-serve", "--minutes", "3"]
    assert CliRunner().invoke(app, line).exit_code == 0
    assert CliRunner().invoke(app, ["rye"]).exit_code == 0
    few = BakeOptions(minutes=3, toppings=("nuts", "figs"), serve=False)
    assert CliRunner().invoke(app, ["rye", *few.words()]).exit_code == 0
    assert got.pop() == ("rye", few) and not BakeOptions().words()
    assert got == [("rye", few), ("rye", BakeOptions())]
    assert not got[1][1].model_fields_set
    assert CliRunner().invoke(app, ["rye", "--minutes", "0"]).exit_code == 2
