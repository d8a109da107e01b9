"""Where the CPU's time goes, kernel by kernel, and what part of the machine's limits that is."""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch

from benchmarks.rasterizers.hits import count_hits
from benchmarks.rasterizers.peers import ours
from benchmarks.rasterizers.timing import once
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.warp import WarpRasterizer
from hoigs.rasterizers.warp.cpu.workers import Cores
from hoigs.rasterizers.warp.records import MOMENTS, RECORD

# stages by kernel, in the order in which they run
STAGES = {
    "project": "project",
    "sort_by_depth": "sort",
    "count_intersections": "intersect",
    "place_intersections": "intersect",
    "scatter_intersections": "intersect",
    "forward_tiles": "forward",
    "backward_tiles": "backward",
    "project_adjoint": "project backward",
}
# Vector operations of one block in `splat_source` and `backward_source`; additions, multiplications
# and multiply-adds count alike: alpha and its growth, weight, next, four channels | value, four
# sums, S, the reciprocal (3), slope (3), three moments.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 8, 24


class TimedCores(Cores):
    """Cores that note how long each kernel took, all its launches together."""

    def __init__(self, cores: Cores) -> None:
        super().__init__(cores.workers, cores.threads)
        self.seconds: dict[str, float] = {}

    def _run(self, launches: list[Any]) -> None:
        start = time.perf_counter()
        super()._run(launches)
        self._note(launches[0].kernel.key, start)

    def once(self, kernel: Any, arguments: list[Any]) -> None:
        start = time.perf_counter()
        super().once(kernel, arguments)
        self._note(kernel.key, start)

    def _note(self, key: str, start: float) -> None:
        self.seconds[key] = self.seconds.get(key, 0.0) + time.perf_counter() - start


def measure(
    gaussians: Gaussians, camera: Camera, limits: dict[str, float], rounds: int
) -> dict[str, Any]:
    """Median milliseconds of each stage, with bytes or hits a second against the limits.

    A stage over Gaussians is held against the copy rate: the bytes that it must read and write at
    least, once. Compositing is held against the multiply-adds: a full block of lanes for every hit,
    no geometry, nothing wasted. What is in no kernel (allocation, autograd, Python) is "other".
    """
    device = torch.device("cpu")
    rasterizer = WarpRasterizer()
    pipeline = rasterizer.pipeline(device)
    pipeline.cores = cores = TimedCores(pipeline.cores)
    drawing = ours(rasterizer)(gaussians, camera)
    times: dict[str, list[float]] = {name: [] for name in [*STAGES.values(), "other"]}
    for number in range(rounds + 2):
        cores.seconds = {}
        sample, _ = once(drawing, device)
        stages = dict.fromkeys(times, 0.0)
        for key, seconds in cores.seconds.items():
            stages[STAGES[key]] += 1e3 * seconds
        stages["other"] = sample.total - sum(stages.values())
        if number >= 2:
            for name, milliseconds in stages.items():
                times[name].append(milliseconds)
    work = _work(gaussians, camera, rasterizer)
    return {
        "counts": {name: work[name] for name in ("gaussians", "visible", "intersections", "hits")},
        "milliseconds": {name: round(statistics.median(x), 3) for name, x in times.items()},
        "of_limit": {
            name: _fraction(name, statistics.median(x) / 1e3, work, limits)
            for name, x in times.items()
            if name != "other"
        },
    }


def count_intersections(
    gaussians: Gaussians, camera: Camera, rasterizer: WarpRasterizer
) -> tuple[int, int]:
    """How many Gaussians are drawn, and how many tile intersections they have."""
    pipeline = rasterizer.pipeline(torch.device("cpu"))
    found: list[tuple[int, int]] = []
    intersect = pipeline.intersect

    def watched(projected: Any, settings: Any) -> Any:
        intersections = intersect(projected, settings)
        found.append((int((projected.drawn_depths > 0).sum()), intersections.count))
        return intersections

    pipeline.intersect = watched
    try:
        rasterizer.render(gaussians, camera)
    finally:
        pipeline.intersect = intersect
    return found[0]


def _work(gaussians: Gaussians, camera: Camera, rasterizer: WarpRasterizer) -> dict[str, int]:
    visible, intersections = count_intersections(gaussians, camera, rasterizer)
    return {
        "gaussians": len(gaussians),
        "visible": visible,
        "intersections": intersections,
        "hits": count_hits(gaussians, camera),
        "raw": 4 * (3 + 4 + 3 + 1 + 3 * gaussians.sh.shape[1]),
    }


def _fraction(
    stage: str, seconds: float, work: dict[str, int], limits: dict[str, float]
) -> dict[str, Any]:
    names = ("gaussians", "visible", "intersections", "raw")
    n, seen, intersections, raw = (work[name] for name in names)
    record, partial = 4 * RECORD, 4 * MOMENTS
    if stage in ("forward", "backward"):
        operations = FORWARD_OPERATIONS if stage == "forward" else BACKWARD_OPERATIONS
        most = limits["multiply_adds"] * limits["lanes"] / operations
        rate = work["hits"] / seconds
        return {"hits_per_second": rate, "most": most, "fraction": round(rate / most, 4)}
    least = {
        "project": n * raw + seen * record + n * 4 * 5,
        "sort": n * 4 + seen * (2 * 8 + 3 * 2 * 8),
        "intersect": 2 * seen * record + intersections * (8 + 2 * 12),
        "project backward": n * 2 * raw + intersections * partial + n * 8,
    }[stage]
    rate = least / seconds
    most = limits["copy_bytes"]
    return {"bytes_per_second": rate, "most": most, "fraction": round(rate / most, 4)}
