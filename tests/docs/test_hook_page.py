"""docs/reference/hooks.md lists the methods of each interface as they are."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

import pytest

from hoigs.core.registry.component import INTERFACES

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "hooks.md").read_text()
SECTIONS = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))


def methods(kind: str) -> dict[str, tuple[str, bool]]:
    """Name -> arguments as the page writes them, and whether it must be written."""
    module, _, name = str(INTERFACES[kind]).partition(":")
    found = {}
    for key, value in vars(getattr(importlib.import_module(module), name)).items():
        if key.startswith("_") or not inspect.isfunction(value):
            continue
        signature = inspect.signature(value)
        shown = [
            parameter.replace(annotation=inspect.Parameter.empty)
            for parameter in list(signature.parameters.values())[1:]
        ]
        text = str(inspect.Signature(shown))[1:-1].replace(" = ", "=")
        text = re.sub(r"<function (\w+) at \w+>", r"\1", text)
        found[key] = (text, getattr(value, "__isabstractmethod__", False))
    return found


@pytest.mark.parametrize("kind", SECTIONS)
def test_every_method_stands_there_with_its_arguments(kind):
    assert f"`{INTERFACES[kind]}`" in SECTIONS[kind]
    rows = re.findall(r"^\| `(\w+)\((.*?)\)` \| (\w*) *\|", SECTIONS[kind], re.M)
    written = {name: (arguments, mark == "required") for name, arguments, mark in rows}
    assert written == methods(kind)


def test_the_kinds_a_newcomer_can_start_with_are_there():
    from hoigs.cli.parts import NewKind

    assert {str(kind) for kind in NewKind} <= set(SECTIONS)
