"""What is imported is declared in pyproject.toml, so that an installation has it."""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# scripts that other Pythons run, whose packages their estimator names
ELSEWHERE = [
    *(ROOT / "hoigs/plugins/estimators/mediapipe").glob("mediapipe_*.py"),
    ROOT / "hoigs/plugins/estimators/object_tracker/outlines_script.py",
]
# what a message asks for by name where it is absent
ASKED_FOR = {"pynvml"}


def declared(requirements: list[str]) -> set[str]:
    return {canonicalize_name(Requirement(text).name) for text in requirements}


DISTRIBUTIONS = packages_distributions()
ALWAYS = declared(PROJECT["dependencies"])
EXTRAS = ALWAYS.union(*map(declared, PROJECT["optional-dependencies"].values()))


def imports(source: str) -> Iterator[tuple[str, bool]]:
    """Packages that are neither Python's nor ours, and whether on importing the module."""

    def found(node: ast.AST, at_once: bool) -> Iterator[tuple[str, bool]]:
        if isinstance(node, ast.Import):
            yield from ((alias.name, at_once) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield str(node.module), at_once
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return
        lazy = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            yield from found(child, at_once and not lazy)

    for name, at_once in found(ast.parse(source), True):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top != "hoigs":
            yield top, at_once


def undeclared(source: str, plugin: bool = False) -> list[str]:
    """Of a module's imports: those on importing it that no installation is sure to have, and those
    within functions that no extra brings. A plugin is imported where it is used, and may lack its
    extra till then."""
    return [
        name
        for name, at_once in imports(source)
        if not {canonicalize_name(d) for d in DISTRIBUTIONS.get(name, [name])}
        & (ALWAYS if at_once and not plugin else EXTRAS)
        and (at_once or name not in ASKED_FOR)
    ]


def test_every_import_is_declared() -> None:
    faults = {}
    for path in sorted((ROOT / "hoigs").rglob("*.py")):
        plugin = path.is_relative_to(ROOT / "hoigs/plugins")
        names = undeclared(path.read_text("utf-8"), plugin)
        if names and path not in ELSEWHERE:
            faults[path.relative_to(ROOT).as_posix()] = names
    assert faults == {}


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import numpy.linalg, os, hoigs.core\nfrom yaml import load", []),
        ("import requests", ["requests"]),
        ("try:\n    from fsspec.core import url_to_fs\nexcept ImportError: ...", ["fsspec"]),
        ("def f():\n    import fsspec\n    from requests.adapters import A", ["requests"]),
        ("if TYPE_CHECKING:\n    import requests", []),
        ("from . import a\nfrom .b import c", []),
    ],
)
def test_which_imports_are_not(source: str, names: list[str]) -> None:
    assert undeclared(source) == names
