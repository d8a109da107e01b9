"""Test frames of a run beside its renders, as one PNG: the pictures in docs come from here.

Usage: python scripts/contact_sheet.py RUN OUT.png [COUNT] [--clip CLIP]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from hoigs.evaluation.report.media import contact_sheet
from hoigs.runs.loaded_run import LoadedRun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("count", type=int, nargs="?", default=5)
    parser.add_argument("--clip", type=Path)
    arguments = parser.parse_args()
    loaded = LoadedRun.open(arguments.run, clip=arguments.clip)
    test = list(loaded.clip.split["test"])
    stride = max(1, len(test) // arguments.count)
    contact_sheet(loaded.model, loaded.clip, test[::stride][: arguments.count], arguments.out)
    print(arguments.out)


if __name__ == "__main__":
    main()
