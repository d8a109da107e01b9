"""Python is started without the modules of the folder where that happens, everywhere in hoigs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hoigs
from hoigs.core.system.environments import PYTHON
from hoigs.studies.execution.local import LocalExecutor, Needs

ROOT = Path(hoigs.__file__).parent
SAFE = {"-P", "-I"}
# modules that many others import, as a data set may have files of these names
NAMES = ("numpy", "json", "socket", "typer", "random", "hoigs", "pickle", "torch")


def commands(tree: ast.Module) -> list[tuple[ast.List | ast.Tuple, set[str]]]:
    """Lists and tuples that may be command lines of Python, with the words that are known."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.List | ast.Tuple) and isinstance(node.ctx, ast.Load):
            words = {ast.unparse(e).strip("'\"") for e in node.elts}
            if words & {"sys.executable", "-m", "-c", "*PYTHON"}:
                found.append((node, words))
    return found


def test_every_python_that_is_started_is_safe():
    seen, used = 0, set()
    for path in ROOT.rglob("*.py"):
        tree = ast.parse(path.read_bytes())
        for node, words in commands(tree):
            seen += 1
            where = f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}"
            # `run_process` of Ray is given PROGRAM[1:], which has the option
            assert words & (SAFE | {"*PYTHON", "*program"}), where
        names = {ast.unparse(n) for n in ast.walk(tree) if isinstance(n, ast.Attribute | ast.Name)}
        if names & {"multiprocessing", "ProcessPoolExecutor", "runpy.run_path"}:
            assert "safe_children" in names, path
            used.add(path.name)
    assert seen >= 8 and used == {"run.py"}
    assert set(PYTHON) & SAFE


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A data set in the current folder, whose modules leave a mark when they are imported."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})\nraise ImportError({name!r})\n"
        )
    monkeypatch.chdir(tmp_path)
    return tmp_path / "ran"


def test_a_job_imports_nothing_from_its_folder(trap):
    process = LocalExecutor().start(("hoigs", "--help"), trap.with_name("log"), Needs())
    assert process is not None
    while (code := process.poll()) is None:
        pass
    assert not trap.exists() and code == 0, trap.with_name("log").read_text()


def test_a_pool_imports_nothing_from_its_folder(trap):
    code = (
        "from hoigs.studies.stress import run\n"
        "run._one_thread, run._make_clip = int, print\n"
        "if __name__ == '__main__': run.make_clips(['a clip'], 1)\n"
    )
    script = trap.with_name("elsewhere") / "main.py"
    script.parent.mkdir()
    script.write_text(code)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert not trap.exists() and done.stdout.strip() == "a clip", done.stderr
