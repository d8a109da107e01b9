"""The public names and their arguments are those of docs/api-surface.txt."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
HOW = (
    "\nIf it is meant: `python scripts/api_surface.py > docs/api-surface.txt`, commit that, and "
    "write a fragment in changelog.d/. A name that goes or changes first warns for a release."
)


def test_the_stub_names_what_the_package_names():
    script = runpy.run_path(str(ROOT / "scripts" / "public_stub.py"))
    assert script["STUB"].read_text() == script["text"](), "run scripts/public_stub.py"


def test_the_surface_is_the_promised_one():
    # in a process of its own: here, shape checking wraps every function
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "api_surface.py")],
        capture_output=True,
        text=True,
        check=True,
    )
    there = set(done.stdout.splitlines())
    promised = set((ROOT / "docs" / "api-surface.txt").read_text().splitlines())
    gone, new = sorted(promised - there), sorted(there - promised)
    listing = "\n".join([*(f"- {line}" for line in gone), *(f"+ {line}" for line in new)])
    assert not (gone or new), f"\n{listing}{HOW}"
