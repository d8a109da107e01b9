"""docs/design/hoigs-equations.md names nothing that is not there."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from hoigs.core.spec.schema import Spec

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "design" / "hoigs-equations.md").read_text()
NAMED = re.findall(r"`(hoigs/[\w/.-]+?\.(?:py|yaml))(?::(\w+))?`", PAGE)
SETTINGS = re.findall(r"^ *--set (.+)$", PAGE, re.M)


def test_the_page_names_enough_to_be_worth_testing():
    assert len(NAMED) > 40 and len(SETTINGS) > 50
    assert len(re.findall(r"--set \w", PAGE)) == len(SETTINGS)  # none escapes the pattern


@pytest.mark.parametrize(("path", "name"), sorted(set(NAMED)))
def test_every_file_and_name_exists(path: str, name: str):
    assert (ROOT / path).is_file()
    if name:
        module = importlib.import_module(path.removesuffix(".py").replace("/", "."))
        assert hasattr(module, name), f"{path} has no {name}"


@pytest.fixture(scope="module")
def plain() -> Spec:
    return Spec.load("hoigs")


@pytest.mark.parametrize("setting", sorted(set(SETTINGS)))
def test_every_setting_is_valid_and_not_the_default(setting: str, plain: Spec):
    changed = Spec.load("hoigs", overrides=[setting])
    assert changed.dump() != plain.dump(), f"{setting} is the default"


def test_the_printed_paper_is_a_spec(plain: Spec):
    printed = Spec.load("hoigs-paper")
    assert printed.train.loss.weights == "supp"
    assert printed.model_hash() != plain.model_hash()
    # the pipeline is the paper's: only settings of its parts differ, and how the splines start
    parts = [set(spec.components().values()) for spec in (printed, plain)]
    assert parts[0] - parts[1] == {"deformation:chs"}
