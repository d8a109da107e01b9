"""Type-check what users write against the wheel that they install.

    python scripts/check_types_for_users.py

Builds the wheel, installs it into a fresh virtual environment that borrows the packages of this
one, and runs mypy over the examples and README's Python block there. It fails when the wheel lacks
`py.typed`, when a public name does not resolve, or when an argument does not fit.
"""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
OPTIONS = (
    "--check-untyped-defs",
    "--no-implicit-reexport",
    "--disallow-any-unimported",
)


def main() -> int:
    with tempfile.TemporaryDirectory() as room:
        folder = Path(room)
        python = environment(folder / "venv", wheel(folder))
        files = folder / "files"
        files.mkdir()
        block = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
        (files / "readme.py").write_text(block.group(1) if block else "")
        for example in (ROOT / "examples").glob("*.py"):
            text = example.read_text(encoding="utf-8")
            if re.search(r"^(import|from) hoigs", text, re.M):  # Blender's own Python has none
                (files / f"example_{example.name}").write_text(text)
        command = [sys.executable, "-m", "mypy", "--config-file=", f"--python-executable={python}"]
        cache = f"--cache-dir={ROOT / '.mypy_cache' / 'users'}"
        names = [path.name for path in sorted(files.iterdir())]
        done = subprocess.run(
            [*command, *OPTIONS, cache, *names],
            cwd=files, capture_output=True, text=True, check=False,
        )  # fmt: skip
        print(done.stdout + done.stderr, end="")
        return done.returncode


def wheel(folder: Path) -> Path:
    """The wheel of this checkout."""
    from hatchling.builders.wheel import WheelBuilder

    return Path(next(WheelBuilder(str(ROOT)).build(directory=str(folder))))


def environment(folder: Path, wheel: Path) -> Path:
    """The Python of a new environment: the wheel, and after it the packages installed here."""
    venv.create(folder, with_pip=False)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    site = folder / "lib" / version / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin" / "python"


if __name__ == "__main__":
    raise SystemExit(main())
