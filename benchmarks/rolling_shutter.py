"""What a rolling shutter costs: times of a global one, rasterizer by rasterizer, in turn.

    python benchmarks/rolling_shutter.py
    python benchmarks/rolling_shutter.py --rasterizers warp --device cuda --gaussians 100000

One round draws the same Gaussians with a global shutter and with rolling ones, each forward alone
and with its gradients, so that whatever else the machine does falls on all of them alike: compare
within one run only. A motion is that of the camera from the first row's exposure to the last one's.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from typing import Any

import torch

from hoigs.core.maths.optics import Optics
from hoigs.core.registry.registry import default_registry
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians

MOTIONS = {"global": None, "2 degrees, 2 cm": (2.0, 0.02), "25 degrees, 50 cm": (25.0, 0.5)}


def camera_moving(camera: Camera, motion: tuple[float, float] | None) -> Camera:
    """A pinhole through the unscented transform, whose shutter rolls while it moves."""
    if motion is None:
        return replace(camera, optics=Optics())
    turn = torch.deg2rad(torch.tensor([0.3, motion[0], 0.2]))
    last = camera.moved(turn, torch.tensor([motion[1], 0.0, 0.0])).world_to_camera
    return replace(camera, optics=Optics(shutter="top_to_bottom", last_world_to_camera=last))


def seconds(rasterizer: Any, gaussians: Gaussians, camera: Camera, backward: bool) -> float:
    """Of one picture, with the gradient of its sum by the means if `backward`."""
    gaussians.means.requires_grad_(backward).grad = None
    began = time.perf_counter()
    color = rasterizer.render(gaussians, camera).color
    if backward:
        color.sum().backward()
    if color.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rasterizers", nargs="+", default=["warp"])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    torch.manual_seed(0)
    points = torch.rand(options.gaussians, 3) * torch.tensor([4.0, 2.2, 2.0]) - 1
    gaussians = Gaussians.from_points(points, scales=0.01).to(options.device)
    eye = torch.tensor([1.0, 0.1, -3.0])
    view = Camera.look_at(eye, torch.tensor([1.0, 0.1, 0.0]), width=640, height=360, fov_y=0.6)
    cameras = {n: camera_moving(view, m).to(options.device) for n, m in MOTIONS.items()}
    print(f"torch {torch.__version__}, {options.device}, {options.gaussians} Gaussians, 640x360")
    print("| rasterizer | | " + " | ".join(f"{n}: ms (times global)" for n in MOTIONS) + " |")
    print("|---|---|" + "---|" * len(MOTIONS))
    for name in options.rasterizers:
        rasterizer = default_registry().concrete(f"rasterizer:{name}")()
        for backward in (False, True):
            found: dict[str, list[float]] = {n: [] for n in MOTIONS}
            for turn in range(options.rounds + 2):
                for motion, camera in cameras.items():
                    taken = seconds(rasterizer, gaussians, camera, backward)
                    found[motion] += [taken] if turn > 1 else []  # the first two warm up
            medians = {n: statistics.median(times) for n, times in found.items()}
            cells = [f"{1e3 * t:.1f} ({t / medians['global']:.1f})" for t in medians.values()]
            what = "forward + backward" if backward else "forward"
            print(f"| {name} | {what} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
