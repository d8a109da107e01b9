"""Most bytes that a training step holds at once, by Gaussian, pixel and tile intersection."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import nnls
from torch.profiler import ProfilerActivity, profile

from benchmarks.rasterizers.peers import ours
from benchmarks.rasterizers.scenes import Case
from benchmarks.rasterizers.stages import count_intersections
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.warp import WarpRasterizer


def peak_bytes(gaussians: Gaussians, camera: Camera, rasterizer: WarpRasterizer) -> int:
    """Most bytes of torch's CPU allocator in one forward and backward, the scene itself left out.

    The gradients of the images and of the raw fields are counted.
    """
    round_ = ours(rasterizer)(gaussians, camera)
    for _ in range(2):  # compiles; keeps the images' gradients
        round_.forward()
        round_.backward()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        round_.forward()
        round_.backward()
    now = most = 0
    events = profiler.profiler.kineto_results.events()
    for event in sorted(events, key=lambda e: e.start_ns()):
        if event.name() == "[memory]":
            now += event.nbytes()
            most = max(most, now)
    return most + 20 * camera.width * camera.height  # the images' gradients, made before


def measure(scenes: list[tuple[Case, Gaussians, Camera]]) -> dict[str, Any]:
    """Bytes a Gaussian, a pixel and a tile intersection that explain the peaks best.

    Returns:
        the three, the peaks, and `unexplained`: how far a peak is from their sum, at most, as a
        fraction. Large splats have more intersections: see `intersections_per_gaussian`.
    """
    rasterizer, rows, table = WarpRasterizer(WarpRasterizer.Config(threads=2)), [], []
    for case, gaussians, camera in scenes:
        _, intersections = count_intersections(gaussians, camera, rasterizer)
        pixels = case.width * case.height
        peak = peak_bytes(gaussians, camera, rasterizer)
        table.append((len(gaussians), pixels, intersections, peak))
        rows.append(
            {
                "case": str(case),
                "peak_bytes": peak,
                "intersections": intersections,
                "intersections_per_gaussian": round(intersections / len(gaussians), 2),
            }
        )
    if len(table) < 3:
        return {"unexplained": "three cases or more are needed", "cases": rows}
    numbers = np.array(table, dtype=np.float64)
    found, _ = nnls(numbers[:, :3] / numbers[:, 3:], np.ones(len(numbers)))
    explained = numbers[:, :3] @ found / numbers[:, 3]
    return {
        "bytes_per_gaussian": round(float(found[0]), 1),
        "bytes_per_pixel": round(float(found[1]), 1),
        "bytes_per_intersection": round(float(found[2]), 1),
        "unexplained": round(float(np.abs(1 - explained).max()), 4),
        "cases": rows,
    }
