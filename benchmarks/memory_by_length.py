"""Peak memory of prepare, train, eval and render against the length of a video.

    python benchmarks/memory_by_length.py --json benchmarks/results/memory-by-length.json
    python benchmarks/memory_by_length.py --light --chunk 100 \\
        --json benchmarks/results/memory-chunked.json
    python benchmarks/memory_by_length.py --table benchmarks/results/memory-by-length.json

A made-up person stands still while a ball goes to and fro; the video's landmarks and the masks of
person and ball together lie beside it, so that no network runs. Each command is a process of its
own, whose peak is what the system counted (`ru_maxrss`). Fits and trainings are short: memory, not
quality, is measured. A command holds the budget if its peak at a length is at most its peak at the
first length, and 64 MiB (training: and the 512 that frames are cached in), and 20 KiB for each
further frame: poses, cameras, numbers and packed masks of a frame are kept in memory, pixels are
not. Exit code 1 if one does not.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hoigs.preparation.report.overlay import VideoWriter

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/preparation"))
import tiny

MARGIN, FRAME = 64 * 2**20, 20 * 2**10  # bytes: of a command, and of a frame
CACHE = {"train": 512 * 2**20}  # of frames
SHORT = 16  # frames of a window in training
COMMANDS = ("prepare", "train", "eval", "render")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lengths", default="100,1000,5000", help="frames")
    parser.add_argument("--scale", type=int, default=4, help="frames are so many times 96x64")
    parser.add_argument("--commands", default=",".join(COMMANDS))
    parser.add_argument(
        "--chunk", type=int, help=f"prepare in windows of so many frames, train in those of {SHORT}"
    )
    parser.add_argument(
        "--light", action="store_true",
        help="frames of 96x64 with masks of person and ball apart, and no overlay: bodies are not "
        "drawn, which takes most of the time",
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, help="keep what is made here, and use it again")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--table", type=Path, metavar="JSON", help="print the docs' table, only")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(json.loads(arguments.table.read_text())))
        return 0
    scale = 1 if arguments.light else arguments.scale
    lengths = [int(word) for word in arguments.lengths.split(",")]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        for frames in lengths:
            folder = (arguments.folder or Path(temporary)) / f"{frames}"
            make_source(folder / "source", frames, scale, arguments.light)
            for name in arguments.commands.split(","):
                took = measured(name, folder, arguments.chunk, arguments.light)
                rows.append({"frames": frames, "command": name, **took})
                print(json.dumps(rows[-1]), flush=True)
    size = [tiny.WIDTH * scale, tiny.HEIGHT * scale]
    record = {"size": size, "lengths": lengths, "chunk": arguments.chunk, "rows": rows,
              "holds": judged(rows)}  # fmt: skip
    print(table(record))
    if arguments.json:
        arguments.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return int(not all(record["holds"].values()))


def measured(name: str, folder: Path, chunk: int | None, light: bool) -> dict[str, Any]:
    """Runs a command in a process of its own, and reads where windows of the body fit meet.

    Raises:
        SystemExit: it fails.
    """
    clip, run = str(folder / "clip"), str(folder / "run")
    words = {
        "prepare": ["prepare", str(folder / "source"), "--out", clip, "--camera", "static",
                    "--set", "fit_steps=5", "--set", "scene_points=500", "--overwrite"],
        "train": ["train", clip, "--out", run, "--overwrite", "--no-eval", "--set",
                  "train.steps=20", "--set", "model.scene.points=300",
                  "--set", "model.human.points=200", "--set", "model.object.points=100"],
        "eval": ["eval", run],
        "render": ["render", run, "--out", str(folder / "film.mp4")],
    }[name]  # fmt: skip
    if chunk is not None and name in ("prepare", "train"):
        words += ["--chunk", str(chunk if name == "prepare" else SHORT)]
    if light and name == "prepare":
        words += ["--set", "overlay_width=0"]
    log = folder / f"{name}.log"
    began = time.perf_counter()
    with log.open("w") as out:
        child = os.posix_spawn(
            sys.executable, [sys.executable, "-m", "hoigs", *words], os.environ,
            file_actions=[(os.POSIX_SPAWN_DUP2, out.fileno(), 1),
                          (os.POSIX_SPAWN_DUP2, out.fileno(), 2)],
        )  # fmt: skip
        _, status, used = os.wait4(child, 0)
    if status:
        raise SystemExit(f"hoigs {' '.join(words)} failed:\n{log.read_text()[-2000:]}")
    seconds = time.perf_counter() - began
    found = {"peak_mib": round(used.ru_maxrss / 2**10, 1), "seconds": round(seconds, 1)}
    if name == "prepare":
        joints = json.loads((folder / "clip/report.json").read_text())["body"].get("joints", [])
        found["joints"] = [[frame, 1000 * metres, degrees] for frame, metres, degrees in joints]
    return found


def make_source(folder: Path, frames: int, scale: int, apart: bool) -> None:
    """Video, landmarks and masks, of both together or `apart`; the ball goes to and fro in the tiny
    scene."""
    if (folder / "pose_mediapipe.npz").is_file():
        return
    names = ("masks/human", "masks/object") if apart else ("hoi_mask",)
    for name in names:
        (folder / name).mkdir(parents=True, exist_ok=True)
    way = list(chain(range(tiny.FRAMES), range(tiny.FRAMES - 2, 0, -1)))
    big = np.ones((scale, scale, 1), np.uint8)
    pictures = [np.kron(tiny.picture(i), big) for i in range(tiny.FRAMES)]
    with VideoWriter(folder / "video.mp4", fps=12, crf=18) as video:
        for i in range(frames):
            at = way[i % len(way)]
            video.add(pictures[at])
            shown = tiny.masks(at) if apart else [np.logical_or(*tiny.masks(at))]
            for name, mask in zip(names, shown, strict=True):
                drawn = np.kron(mask.astype(np.uint8), big[..., 0]) * 255
                Image.fromarray(drawn).save(folder / f"{name}/{i:05d}.png", compress_level=1)
    known = {k: np.repeat(v[:1], frames, 0) for k, v in tiny.landmarks().items()}
    known["image_xyzv"][..., :3] *= scale
    np.savez(folder / "pose_mediapipe.npz", **known)


def judged(rows: list[dict[str, Any]]) -> dict[str, bool]:
    """Whether each command holds the budget at every length."""
    holds = {}
    for name in {row["command"]: None for row in rows}:
        first, *others = [row for row in rows if row["command"] == name]
        holds[name] = all(
            2**20 * (row["peak_mib"] - first["peak_mib"])
            <= MARGIN + CACHE.get(name, 0) + FRAME * (row["frames"] - first["frames"])
            for row in others
        )
    return holds


def table(record: dict[str, Any]) -> str:
    """Markdown: a row a command, peak and seconds at each length."""
    heads = [f"{n:,} frames" for n in record["lengths"]]
    lines = ["| | " + " | ".join(heads) + " | budget |", "|---" * (len(heads) + 2) + "|"]
    for name, holds in record["holds"].items():
        found = [r for r in record["rows"] if r["command"] == name]
        cells = [f"{r['peak_mib']:,.0f} MiB, {r['seconds']:.0f} s" for r in found]
        lines.append("| " + " | ".join([name, *cells, "held" if holds else "**not held**"]) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
