"""How fast SSIM and its gradient are: interleaved medians, and ratios to our kernels.

    python benchmarks/ssim.py
    python benchmarks/ssim.py --device cuda --json ssim-cuda.json

One round runs every implementation once, in turn, so that whatever else the machine does falls on
all of them alike: compare within one run only. A time is one forward and one backward of the mean
SSIM of an image [H, W, 3] to that image. `error` is the relative distance of the gradient to the
float64 twin's, over the pixels that no window at the border sees, since kornia pads by reflection.
fused-ssim takes part on CUDA where it is installed.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hoigs.metrics.ssim import ssim

Score = Callable[[Tensor, Tensor], Tensor]  # images [H, W, 3] to the mean
FIRST = "warp"


def by_kornia(image: Tensor, target: Tensor) -> Tensor:
    from kornia.metrics import ssim as kornia_ssim

    planes = (x.permute(2, 0, 1)[None] for x in (image, target))
    value: Tensor = kornia_ssim(*planes, 11, eps=0.0).mean()
    return value


def by_fused_ssim(image: Tensor, target: Tensor) -> Tensor:
    import fused_ssim

    planes = (x.permute(2, 0, 1)[None].contiguous() for x in (image, target))
    value: Tensor = fused_ssim.fused_ssim(*planes)
    return value


def contestants(device: torch.device) -> dict[str, Score]:
    found: dict[str, Score] = {
        FIRST: lambda x, y: ssim(x, y, "warp"),
        "torch": ssim,
        "kornia": by_kornia,
    }
    if device.type == "cuda" and importlib.util.find_spec("fused_ssim") is not None:
        found["fused-ssim"] = by_fused_ssim
    return found


def images(height: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """A render and its target: waves, edges and noise."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.arange(height) / 50, torch.arange(width) / 50, indexing="ij")
    target = torch.stack((torch.sin(3 * x + y), torch.cos(x * y), (x + y).frac()), -1) * 0.4 + 0.5
    noise = torch.randn(height, width, 3, generator=generator)
    return (target + 0.05 * noise).clamp(0, 1).to(device), target.clamp(0, 1).to(device)


def clock(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1e3 * time.perf_counter()


def once(score: Score, image: Tensor, target: Tensor) -> tuple[float, float, Tensor]:
    """Milliseconds forward and backward, and the gradient."""
    x = image.clone().requires_grad_()
    start = clock(x.device)
    value = score(x, target)
    middle = clock(x.device)
    value.backward()
    end = clock(x.device)
    assert x.grad is not None
    return middle - start, end - middle, x.grad


def case(scores: dict[str, Score], size: str, device: torch.device, rounds: int) -> list[dict]:
    width, height = map(int, size.split("x"))
    image, target = images(height, width, device)
    exact = once(ssim, image.double(), target.double())[2][10:-10, 10:-10]
    exact = exact / exact.norm()  # kornia's mean is over as many pixels, others' need not be
    errors = {}
    for name, score in scores.items():
        gradient = once(score, image, target)[2][10:-10, 10:-10].double()
        errors[name] = float((gradient / gradient.norm() - exact).norm())
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in scores}
    for _ in range(rounds):
        for name, score in scores.items():
            times[name].append(once(score, image, target)[:2])
    totals = {name: statistics.median(map(sum, taken)) for name, taken in times.items()}
    return [
        {
            "size": size,
            "implementation": name,
            "rounds": rounds,
            "forward_ms": round(statistics.median(t[0] for t in taken), 4),
            "backward_ms": round(statistics.median(t[1] for t in taken), 4),
            "total_ms": round(totals[name], 4),
            "fastest_ms": round(min(map(sum, taken)), 4),
            f"times_{FIRST}": round(totals[name] / totals[FIRST], 2),
            "error": float(f"{errors[name]:.2g}"),
        }
        for name, taken in times.items()
    ]


def machine(device: torch.device) -> dict[str, Any]:
    versions = {}
    for package in ("torch", "warp-lang", "kornia", "hoigs", "fused-ssim"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "processor": platform.processor() or platform.machine(),
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_before": [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else [],
        "python": platform.python_version(),
        "versions": versions,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=["256x256", "640x360", "1280x720"])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    device = torch.device(options.device)
    report: dict[str, Any] = {"machine": machine(device), "cases": []}
    for size in options.sizes:
        rows = case(contestants(device), size, device, options.rounds)
        report["cases"] += rows
        for row in rows:
            if len(report["cases"]) == len(rows) and row is rows[0]:
                print("  ".join(f"{key:>14}" for key in row))
            print("  ".join(f"{value!s:>14}" for value in row.values()), flush=True)
    if options.json:
        partial = options.json.with_suffix(".partial")
        partial.write_text(json.dumps(report, indent=1))
        partial.replace(options.json)


if __name__ == "__main__":
    main()
