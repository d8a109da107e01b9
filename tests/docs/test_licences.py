"""Every dependency that is installed may be used and passed on with an Apache-2.0 program."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "scripts" / "licences.py"))
closure, faults, licence = SCRIPT["closure"], SCRIPT["faults"], SCRIPT["licence"]


def test_what_is_installed_here() -> None:
    licences = {name: licence(dist) for name, dist in closure("hoigs").items()}
    assert {"torch", "numpy", "warp-lang", "pillow"} <= set(licences)
    assert faults(licences) == []


@pytest.mark.parametrize(
    ("text", "allowed"),
    [
        ("MIT", True),
        ("GPL-2.0-only OR MIT", True),
        ("LGPL-3.0-or-later", True),
        ("GNU Lesser General Public License v3 (LGPLv3)", True),
        ("GPL-3.0-or-later", False),
        ("GNU Affero General Public License v3", False),
        ("MIT AND GPL-3.0-only", False),
        ("CC-BY-NC-4.0", False),
        ("Free for non-commercial use", False),
        ("", False),
    ],
)
def test_which_are_allowed(text: str, allowed: bool) -> None:
    assert (faults({"a": text}) == []) is allowed
