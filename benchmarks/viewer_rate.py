"""Frames a second of the viewer while its camera moves, and while time runs: drawing and JPEG.

    python benchmarks/viewer_rate.py RUN [--device cpu] [--seconds 4]

A row for each fixed width, and one for the width that the viewer chooses within its time. Sending
the picture and showing it in the browser are not in these numbers: on one machine they are small,
over a network they are the limit.
"""

# ruff: noqa: E402
from __future__ import annotations

from hoigs.core.system.threads import share_processors

share_processors()  # as the command does, before torch is imported

import argparse
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import torch
from PIL import Image

from hoigs.evaluation.measure import orbit_cameras
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.run_folder import versions
from hoigs.viewing.viewer.run_drawing import BUDGET_S, Look, Resolution, RunDrawing

WIDTHS = (256, 640, 1280)
QUALITY = 80
STEPS = 60  # cameras of the orbit


def rate(draw: Callable[[int], object], seconds: float) -> float:
    """Calls a second, after three that do not count."""
    for i in range(3):
        draw(i)
    began, count = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        draw(count)
        count += 1
    return count / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seconds", type=float, default=4.0, help="of each number")
    given = parser.parse_args()
    loaded = LoadedRun.open(given.run, device=given.device)
    drawing, look = RunDrawing(loaded), Look(entities=frozenset(loaded.model.entities))
    cameras = orbit_cameras(loaded.clip, loaded.model, STEPS)
    frames = loaded.clip.num_frames

    def picture(frame: float, index: int, width: int) -> None:
        camera = cameras[index % STEPS]
        height = max(1, round(width * camera.height / camera.width))
        image = drawing.draw(frame, camera.resized(width, height), look).image
        Image.fromarray(image).save(BytesIO(), "jpeg", quality=QUALITY)

    resolution, canvas = Resolution(max(WIDTHS)), (1280, 1280)

    def chosen(index: int, moving_time: bool) -> None:
        began = time.perf_counter()
        width = resolution.size(canvas, moving=True)[0]
        picture(index % frames if moving_time else 0.0, index, width)
        resolution.took(time.perf_counter() - began)

    count = sum(loaded.model.count().values())
    print(f"{versions()['machine']}, {loaded.model.device}, {torch.get_num_threads()} threads")
    print(f"{loaded.spec.name} on {loaded.clip.name}: {count} Gaussians\n")
    print("| width | camera moves, frames/s | time runs, frames/s |\n|---|---|---|")
    for width in WIDTHS:
        still = rate(lambda i, w=width: picture(0.0, i, w), given.seconds)
        runs = rate(lambda i, w=width: picture(float(i % frames), i, w), given.seconds)
        print(f"| {width} | {still:.1f} | {runs:.1f} |", flush=True)
    rates, widths = [], []
    for moving_time in (False, True):
        for i in range(25):  # lets the width settle
            chosen(i, moving_time)
        rates.append(rate(lambda i, m=moving_time: chosen(i, m), given.seconds))
        widths.append(resolution.size(canvas, moving=True)[0])
    cells = " | ".join(f"{r:.1f} ({w} wide)" for r, w in zip(rates, widths, strict=True))
    print(f"| chosen for {BUDGET_S:.2f} s | {cells} |")


if __name__ == "__main__":
    main()
