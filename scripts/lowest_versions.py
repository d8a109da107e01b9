"""The lowest versions that pyproject.toml declares, installed together, and what passes with them.

    python scripts/lowest_versions.py --environment build/lowest --torch 2.13.0+cpu
    python scripts/lowest_versions.py --show             # the pins alone

Every requirement of hoigs, of its test tools and of the extras that the tests use is pinned to the
version behind its `>=`; what these need in turn is pip's choice. torch is taken as named by
--torch: Linux wheels of its older releases bring gigabytes of CUDA with them. Afterwards the tests
of TESTS that are not slow run there. The record says what was installed and what passed.
Exit code 1 if pip finds no such set, or a test fails.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "benchmarks" / "results" / "lowest-versions.json"
# checkers of the source say nothing of a user's environment, and follow their newest versions
LEFT_OUT = {"ruff", "mypy", "import-linter", "types-pyyaml", "playwright"}
TESTS = (
    "core", "runs", "metrics", "rasterizers/test_warp.py", "plugins/readers", "plugins/exporters",
    "plugins/initializers/sds", "plugins/estimators/test_transformers.py",
    "plugins/test_settings.py", "plugins/test_isolation.py", "cli/test_bad_input.py",
    "viewing/test_view_parts.py",
)  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--environment", type=Path, default=ROOT / "build" / "lowest")
    parser.add_argument("--torch", default="", help="its version; default: the lowest declared")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="below tests/")
    parser.add_argument("--show", action="store_true", help="print the pins, install nothing")
    parser.add_argument("--json", type=Path, default=RECORD)
    arguments = parser.parse_args()
    pins = lowest(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"])
    declared = dict(pins)
    if arguments.torch:
        pins["torch"] = arguments.torch
    if arguments.show:
        print("\n".join(f"{name}=={version}" for name, version in pins.items()))
        return 0
    python = installed(arguments.environment, pins)
    found = tested(python, arguments.tests)
    record = {
        "command": "python scripts/lowest_versions.py"
        + f" --torch {arguments.torch}" * bool(arguments.torch),
        "declared": declared,
        "not the lowest": {name: pins[name] for name in pins if pins[name] != declared[name]},
        "tests": list(arguments.tests),
        **found,
    }
    arguments.json.write_text(json.dumps(record, indent=1) + "\n")
    print(found["outcome"])
    return found["exit_code"]


def lowest(project: dict[str, Any]) -> dict[str, str]:
    """Name to the version behind `>=`, the highest one where several extras name it."""
    extras = project["optional-dependencies"]
    texts = [*project["dependencies"], *extras["dev"]]
    for text in extras["dev"]:
        if mine := re.fullmatch(r"hoigs\[(\w+)\]", text):
            texts += extras[mine[1]]
    found: dict[str, str] = {}
    for need in map(Requirement, texts):
        name = canonicalize_name(need.name)
        lows = [part.version for part in need.specifier if part.operator == ">="]
        if lows and name not in LEFT_OUT:
            found[name] = max(lows[0], found.get(name, "0"), key=Version)
    return dict(sorted(found.items()))


def installed(environment: Path, pins: dict[str, str]) -> Path:
    """The interpreter of a new environment with these versions and hoigs from this folder."""
    subprocess.run([sys.executable, "-m", "venv", "--clear", str(environment)], check=True)
    python = (environment / "bin" / "python").absolute()
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    chosen = [f"{name}=={version}" for name, version in pins.items()]
    subprocess.run([*install, *chosen], check=True)
    subprocess.run([*install, "--no-deps", "-e", str(ROOT)], check=True)
    return python


def tested(python: Path, tests: list[str]) -> dict[str, Any]:
    """pytest's exit code, last line and the names of what failed."""
    ran = subprocess.run(
        [str(python), "-m", "pytest", "-p", "no:cacheprovider", "-m", "not slow",
         *(f"tests/{test}" for test in tests)],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    lines = ran.stdout.splitlines() or ran.stderr.splitlines()
    return {
        "exit_code": ran.returncode,
        "outcome": re.sub(r" in [\d.]+s.*", "", lines[-1].strip("= ")),
        "failed": [line for line in lines if line.startswith(("FAILED", "ERROR "))],
    }


if __name__ == "__main__":
    sys.exit(main())
