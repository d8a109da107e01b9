"""The body fit of a real clip at once and in windows: what differs, and where windows meet.

    python benchmarks/windowed_fit.py SHARED/juggle --json benchmarks/results/windowed-fit.json

Landmarks are those of `pose_mediapipe.npz` in a folder of 1280x720 frames of a camera that stands
still, 24 a second. A joint is the first frame that a window solves anew; both windows' places and
orientations of the body's 22 joints are compared there. Exit code 1 if one is over 1 cm or 2
degrees with the default overlap.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hoigs.core.maths.frame_times import Chunking
from hoigs.core.values.camera import Camera
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.fitted import BodyFit
from hoigs.preparation.body.landmarks import Landmarks

WIDTH, HEIGHT, FOCAL, FPS = 1280, 720, 1536.0, 24


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--chunks", default="60:15,120:15,120:30", help="frames:overlap")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    arrays = np.load(arguments.source / "pose_mediapipe.npz")
    marks = Landmarks.from_mediapipe(arrays["image_xyzv"], arrays["world_xyzv"])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cameras = [Camera(K, torch.eye(4), WIDTH, HEIGHT)] * len(marks.image)
    body, times = AnnyBody(), torch.arange(len(cameras)) / FPS
    rows: list[dict[str, Any]] = []
    whole: BodyFit | None = None
    for chunking in [None, *map(_chunking, arguments.chunks.split(","))]:
        began = time.perf_counter()
        fit = fit_body(body, Observations(marks, cameras, times), chunking=chunking)
        row = {
            "chunk": chunking and chunking.chunk, "overlap": chunking and chunking.overlap,
            "seconds": round(time.perf_counter() - began, 1),
            "landmark_error_px": fit.report["landmark_error_px"],
            "joints": [[j.frame, round(1000 * j.metres, 2), round(j.degrees, 2)]
                       for j in fit.joints],
        }  # fmt: skip
        if whole is None:
            whole = fit
        else:
            row["off_the_whole_mm"] = _apart(body, fit, whole)
        rows.append(row)
        print(json.dumps(row), flush=True)
    record = {"source": arguments.source.name, "frames": len(cameras), "rows": rows}
    print(table(record))
    if arguments.json:
        arguments.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return int(any(mm > 10 or degrees > 2 for _, mm, degrees in rows[-1]["joints"]))


def _chunking(word: str) -> Chunking:
    return Chunking(*map(int, word.split(":")))


@torch.no_grad()
def _apart(body: AnnyBody, fit: BodyFit, whole: BodyFit) -> float:
    """Median distance of the body's joints about the pelvis, whose depth the shape decides."""
    at = [body(f.poses).joints[:, :22] for f in (fit, whole)]
    one, other = (joints - joints[:, :1] for joints in at)
    return round(1000 * float((one - other).norm(dim=-1).median()), 1)


def table(record: dict[str, Any]) -> str:
    """Markdown for the docs."""
    lines = [
        "| windows | overlap | apart at the joints | off the fit at once | landmarks off | s |",
        "|---|---|---|---|---|---|",
    ]
    for row in record["rows"]:
        joints = row["joints"]
        apart = "–" if not joints else (
            f"{max(j[1] for j in joints):.1f} mm, {max(j[2] for j in joints):.1f} degrees"
        )  # fmt: skip
        off = f"{row['off_the_whole_mm']:.1f} mm" if joints else "–"
        count = f"{len(joints) + 1} of {row['chunk']} frames" if joints else "at once"
        error = f"{row['landmark_error_px']:.1f} px"
        cells = (count, row["overlap"] or "–", apart, off, error, f"{row['seconds']:.0f}")
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
