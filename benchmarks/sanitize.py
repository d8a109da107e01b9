"""compute-sanitizer over the CUDA kernels of rasterizer:warp and its SSIM, at small sizes.

    python benchmarks/sanitize.py --json benchmarks/results/sanitize.json
    python benchmarks/sanitize.py --work          # what runs under the tool, without the tool

Renders with and without feature channels, absolute gradients and room for the intersections, all
with gradients, cameras with optics, then SSIM with its gradient, under memcheck (memory out of
bounds), racecheck (shared memory written and read without a barrier) and synccheck (barriers that
some threads of a block miss). torch takes its memory without its cache, which would hide what lies
beyond an array. Exit code 1 if a tool finds anything, or cannot be run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

TOOLS = ("memcheck", "racecheck", "synccheck")
PLACES = ("/usr/local/cuda/bin", "/usr/local/cuda/compute-sanitizer")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tools", nargs="+", choices=TOOLS, default=TOOLS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--work", action="store_true", help="only draw, without a tool")
    arguments = parser.parse_args()
    if arguments.work:
        return work()
    path = os.pathsep.join((os.environ.get("PATH", ""), *PLACES))
    program = shutil.which("compute-sanitizer", path=path)
    if program is None:
        print("not run: there is no compute-sanitizer on the path, it comes with the CUDA toolkit")
        return 1
    found = {tool: sanitized(program, tool) for tool in arguments.tools}
    record = {"device": device_name(), "tools": found}
    print(json.dumps(record, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")
    return int(any(tool["exit_code"] for tool in found.values()))


def sanitized(program: str, tool: str) -> dict[str, Any]:
    """The exit code, the tool's last word and, where it found something, its report."""
    start = time.perf_counter()
    ran = subprocess.run(
        [program, "--tool", tool, "--error-exitcode", "9", "--target-processes", "all",
         sys.executable, __file__, "--work"],
        capture_output=True, text=True, check=False,
        env=os.environ | {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"},
    )  # fmt: skip
    lines = [line for line in ran.stdout.splitlines() if line.startswith("=========")]
    summary = [line.strip("= ") for line in lines if re.search("SUMMARY", line)]
    kept: dict[str, Any] = {
        "exit_code": ran.returncode,
        "summary": summary[-1] if summary else "none",
        "drawn": [line for line in ran.stdout.splitlines() if line.startswith("drawn")],
        "seconds": round(time.perf_counter() - start),
    }
    if ran.returncode:
        kept["report"] = [*lines[:40], *ran.stderr.splitlines()[-20:]]
    return kept


def device_name() -> str:
    import torch

    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"


def work() -> int:
    """Renders and SSIM on CUDA, with their gradients."""
    import torch

    from hoigs.core.interfaces.rasterizer import RenderRequest
    from hoigs.core.maths.optics import Optics
    from hoigs.metrics.kernels.ssim import mean_ssim, ssim_map
    from hoigs.rasterizers.warp import WarpRasterizer
    from hoigs.rasterizers.warp.cuda import intersections
    from hoigs.testing.rasterizer.subject import a_camera, random_gaussians

    if not torch.cuda.is_available():
        print("not run: no CUDA device")
        return 1
    cuda = torch.device("cuda", 0)
    camera = a_camera(70, 45).to(cuda)
    rule = intersections.MANY, intersections.DENSE
    for count, in_two_parts in ((1, False), (400, False), (3000, True)):
        intersections.MANY, intersections.DENSE = (0, 0) if in_two_parts else rule
        gaussians = random_gaussians(count).to(cuda)
        for channels in (0, 6):
            for absolute in (False, True):
                request = RenderRequest(
                    features=torch.randn(count, channels, device=cuda) if channels else None,
                    screen_offsets=torch.zeros(count, 2, device=cuda, requires_grad=True),
                    absolute_gradients=(
                        torch.zeros(count, 2, device=cuda, requires_grad=True) if absolute else None
                    ),
                )
                rasterizer = WarpRasterizer()
                for room in (True, False):
                    if not room:
                        rasterizer.pipeline(cuda).capacity._capacity = max(1, count // 2)
                    leaves = gaussians.map(lambda x: x.detach().clone().requires_grad_())
                    out = rasterizer.render(leaves, camera, request)
                    loss = out.color.square().mean() + out.alpha.mean() + out.depth.mean()
                    if channels:
                        loss = loss + out.features.square().mean()
                    loss.backward()
                    torch.cuda.synchronize()
                    print(f"drawn {count} {channels} {absolute} {room} {float(loss):.6f}")
    intersections.MANY, intersections.DENSE = rule
    last = camera.world_to_camera.clone()
    last[0, 3] += 0.02
    rolling = {"shutter": "top_to_bottom", "last_world_to_camera": last}
    for optics in (
        Optics("fisheye", radial=(0.02, 0.001)),
        Optics("ortho"),
        Optics(radial=(0.05, 0.01), tangential=(0.001, 0.002), **rolling),
    ):
        seen = replace(camera, optics=optics)
        leaves = random_gaussians(400).to(cuda).map(lambda x: x.detach().requires_grad_())
        out = WarpRasterizer().render(leaves, seen)
        (out.color.square().mean() + out.depth.mean()).backward()
        torch.cuda.synchronize()
        print(f"drawn {optics.model} {optics.shutter} {float(out.color.mean()):.6f}")
    image = torch.rand(61, 83, 3, device=cuda, requires_grad=True)
    target = torch.rand(61, 83, 3, device=cuda)
    score = mean_ssim(image, target)
    score.backward()
    ssim_map(image.detach(), target)
    torch.cuda.synchronize()
    print(f"drawn SSIM {float(score):.6f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
