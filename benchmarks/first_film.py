"""From the README to a film of one's own video: each command as it is typed there, and its time.

    python benchmarks/first_film.py my.mp4 --out FOLDER
    python benchmarks/first_film.py my.mp4 --out FOLDER --object ball=466,420   # a click
    python benchmarks/first_film.py --table                                     # of the results

The commands are lines of README.md, and the script ends where one of them is no longer there, or
fails. Of each it records the seconds on the clock and those of the processors (other work beside
it stretches the first, not the second), the largest memory, and the files that it made. Results go
to benchmarks/results/first-film.json after every command; what each printed is in FOLDER/said.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/first-film.json"
# as in README.md, and what each makes
TYPED = {
    "hoigs prepare my.mp4 --out clips/mine --width 640": ("clips/mine",),
    "hoigs train clips/mine --out runs/mine": ("runs/mine", "runs/mine/report.html"),
    "hoigs render runs/mine --path bullet-time": ("runs/mine/renders/bullet-time.mp4",),
    "hoigs view runs/mine --html page.html": ("page.html",),
    "hoigs export runs/mine --format ply": ("runs/mine/exports/ply",),
}


def require_in_readme() -> None:
    """Raises SystemExit where a command is not a line of the README."""
    lines = [line.partition("#")[0].rstrip() for line in (ROOT / "README.md").open()]
    missing = [command for command in TYPED if command not in lines]
    if missing:
        raise SystemExit(f"README.md has no line {missing[0]!r}")


def megabytes(path: Path) -> float:
    if not path.exists():
        raise SystemExit(f"{path} was not made")
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return round(sum(p.stat().st_size for p in files) / 1e6, 1)


def typed(command: str, folder: Path, more: list[str]) -> dict[str, Any]:
    """Runs one command in the folder; its times, memory and files.

    Args:
        more: words that a user adds, such as a click; of `hoigs prepare` alone.
    """
    words = [*shlex.split(command), *more]
    said = folder / "said" / f"{words[1]}.txt"
    said.parent.mkdir(exist_ok=True)
    load, began = os.getloadavg()[0], time.perf_counter()
    with said.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "hoigs", *words[1:]], cwd=folder, stdout=file,
            stderr=subprocess.STDOUT, env=os.environ | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{shlex.join(words)} failed:\n{said.read_text()}")
    return {
        "typed": shlex.join(words),
        "seconds": round(seconds, 1),
        "processor_seconds": round(used.ru_utime + used.ru_stime, 1),
        "peak_gb": round(used.ru_maxrss / 1e6, 2),
        "load_before": round(load, 1),
        "made_mb": {name: megabytes(folder / name) for name in TYPED[command]},
    }


def table(found: dict[str, Any]) -> str:
    lines = ["| typed | seconds | of processors | GB | made |", "|---|---|---|---|---|"]
    for row in found["commands"]:
        made = ", ".join(f"{name}: {size} MB" for name, size in row["made_mb"].items())
        lines.append(
            f"| `{row['typed']}` | {row['seconds']:.0f} | {row['processor_seconds']:.0f} | "
            f"{row['peak_gb']} | {made} |"
        )
    whole = [sum(row[key] for row in found["commands"]) for key in ("seconds", "processor_seconds")]
    return "\n".join([*lines, f"| together | {whole[0]:.0f} | {whole[1]:.0f} | | |"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path, nargs="?")
    parser.add_argument("--out", type=Path, help="new folder, in which the commands are typed")
    parser.add_argument("--object", action="append", default=[], help="as of hoigs prepare")
    parser.add_argument("--source", default="", help="where the video is from, for the record")
    parser.add_argument("--json", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true", help="print the table of --json")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(json.loads(arguments.json.read_text())))
        return
    if arguments.video is None or arguments.out is None:
        parser.error("VIDEO and --out are needed, or --table")
    require_in_readme()
    arguments.out.mkdir(parents=True)
    shutil.copyfile(arguments.video, arguments.out / "my.mp4")
    commit = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    found: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "code": commit.stdout.strip(),
        "processors": os.cpu_count(),
        "video": arguments.source or arguments.video.name,
        "video_mb": megabytes(arguments.video),
        "commands": [],
    }
    clicks = [word for click in arguments.object for word in ("--object", click)]
    for command in TYPED:
        more = clicks if " prepare " in command else []
        found["commands"].append(typed(command, arguments.out, more))
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
        print(table(found), flush=True)


if __name__ == "__main__":
    main()
