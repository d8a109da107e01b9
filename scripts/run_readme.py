"""Run the README's Python to its end, as it stands there, and say how long it took.

    python scripts/run_readme.py --out build/readme    # frame.png is left there

The tests run the same lines with two steps on the smallest clip. Exit code 1 if the picture is
less than 20 dB from the frame of the clip that it shows.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from pathlib import Path
from typing import Any

import torch

README = Path(__file__).resolve().parents[1] / "README.md"
ENOUGH_DB = 20.0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("build/readme"))
    arguments = parser.parse_args()
    code = re.search(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
    if code is None:
        raise SystemExit(f"{README} has no block of Python")
    arguments.out.mkdir(parents=True, exist_ok=True)
    os.chdir(arguments.out)
    names: dict[str, Any] = {}
    began = time.perf_counter()
    exec(compile(code[1], str(README), "exec"), names)
    seconds = time.perf_counter() - began
    error = (names["image"].detach() - names["clip"][12].rgb).square().mean()
    decibels = float(-10 * torch.log10(error))
    print(f"{seconds:.0f} s; {Path('frame.png').resolve()}: {decibels:.1f} dB")
    return int(decibels < ENOUGH_DB)


if __name__ == "__main__":
    sys.exit(main())
