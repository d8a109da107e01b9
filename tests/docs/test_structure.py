"""No module imports itself in a circle, and the pages on structure name files that exist."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "design" / "structure.md"


def test_no_module_imports_itself_in_a_circle() -> None:
    script = ROOT / "scripts" / "structure.py"
    done = subprocess.run(
        [sys.executable, str(script), "--check"],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("page", [PAGE, ROOT / "ARCHITECTURE.md"], ids=lambda page: page.name)
def test_every_file_that_the_tables_name_is_there(page: Path) -> None:
    named = set(re.findall(r"`(hoigs/[\w/]+(?:\.py|/))`", page.read_text(encoding="utf-8")))
    assert len(named) > 12
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []
