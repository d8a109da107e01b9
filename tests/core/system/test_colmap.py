"""COLMAP's log library leaves SIGTERM to hoigs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import hoigs

CODE = """
import signal, sys
from hoigs.cli.failures import failures_as_messages

with failures_as_messages():
    from hoigs.core.system.colmap import pycolmap
    signal.raise_signal(signal.SIGTERM)
"""


def test_sigterm_stays_what_it_was():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (143, "stopped\n")


def test_every_module_takes_pycolmap_from_one_place():
    imports = re.compile(r"^\s*(import|from) pycolmap", re.MULTILINE)
    root = Path(hoigs.__file__).parent
    found = [p for p in root.rglob("*.py") if imports.search(p.read_text(encoding="utf-8"))]
    assert found == [root / "core/system/colmap.py"]
