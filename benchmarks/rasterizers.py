"""How fast each rasterizer draws and differentiates: interleaved medians, and ratios.

    python benchmarks/rasterizers.py
    python benchmarks/rasterizers.py --backends warp torch --sizes 256x256 --counts 20000
    python benchmarks/rasterizers.py --device cuda --backends warp gsplat gswarp --out cuda.json

One round runs every backend once, in turn, so that whatever else the machine does falls on all of
them alike: compare within one run only. A time is one forward and one backward from colour, alpha
and depth to every raw field, projection and activation included. `difference` is the mean absolute
difference of the picture to the first backend's: a faster picture must still be the same picture.
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

import numpy as np
import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import RenderRequest

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).parents[2] / "shared"))
GARDEN = SHARED / "data" / "garden.npz"
Draw = Callable[[Gaussians, Camera], tuple[Tensor, ...]]  # colour [H, W, 3], then others


def synthetic(count: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """A ball of splats with harmonics of degree 3, some pixels each."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=normal(count, 3) * 0.6,
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.5 - 2.2 - torch.tensor(count / 1000).log() / 3,
        opacity_logits=normal(count),
        sh=normal(count, 16, 3) * 0.2,
    )
    eye, target = torch.tensor([0.5, -0.6, -3.0]), torch.zeros(3)
    return gaussians, Camera.look_at(eye, target, width=512, height=512, fov_y=0.8)


def garden(count: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """gsplat's test asset cropped to 2 m: scales from neighbours, times lognormal(0.5)."""
    data = np.load(GARDEN)
    points = torch.from_numpy(data["means3d"])
    colors = torch.from_numpy(data["colors"]).float() / 255
    inside = (points.abs() < 2).all(1).nonzero().squeeze(1)
    generator = torch.Generator().manual_seed(seed)
    chosen = inside[torch.randperm(len(inside), generator=generator)[:count]]
    gaussians = Gaussians.from_points(points[chosen], colors[chosen])
    normal = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    gaussians = gaussians.replace(
        log_scales=gaussians.log_scales + 0.5 * normal(len(chosen), 3),
        quats=normal(len(chosen), 4),
        opacity_logits=normal(len(chosen)),
    )
    K, view = (torch.from_numpy(data[name][0]).float() for name in ("Ks", "viewmats"))
    return gaussians, Camera(K, view, int(data["width"]), int(data["height"]))


def ours(rasterizer: Any) -> Draw:
    def draw(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
        output = rasterizer.render(gaussians, camera)
        return output.color, output.alpha, output.depth

    return draw


def draw_gsplat(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
    import gsplat

    request = RenderRequest()
    image, alpha, _ = gsplat.rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera.world_to_camera[None],
        camera.K[None],
        camera.width,
        camera.height,
        near_plane=request.near,
        eps2d=request.low_pass,
        sh_degree=gaussians.sh_degree,
        render_mode="RGB+D",
        packed=False,
    )
    return image[0, ..., :3], alpha[0, ..., 0], image[0, ..., 3]


def draw_gswarp(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
    """Colour only, as far as gradients go: its interface is that of 3DGS."""
    import gswarp

    view, device = camera.world_to_camera, gaussians.means.device
    near, far = 0.01, 100.0
    width, height = camera.width, camera.height
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    clip = torch.tensor(
        [
            [2 * fx / width, 0, 2 * float(camera.K[0, 2]) / width - 1, 0],
            [0, 2 * fy / height, 2 * float(camera.K[1, 2]) / height - 1, 0],
            [0, 0, far / (far - near), -far * near / (far - near)],
            [0, 0, 1, 0],
        ],
        device=device,
    )
    settings = gswarp.GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=width / (2 * fx),
        tanfovy=height / (2 * fy),
        bg=torch.zeros(3, device=device),
        scale_modifier=1.0,
        viewmatrix=view.T.contiguous(),
        projmatrix=(clip @ view).T.contiguous(),
        sh_degree=gaussians.sh_degree,
        campos=camera.center,
        prefiltered=False,
        auto_tune_verbose=False,
    )
    output = gswarp.GaussianRasterizer(settings)(
        means3D=gaussians.means,
        means2D=torch.zeros_like(gaussians.means),
        opacities=gaussians.opacities[:, None],
        shs=gaussians.sh,
        scales=gaussians.scales,
        rotations=torch.nn.functional.normalize(gaussians.quats, dim=-1),
    )
    return (output[0].permute(1, 2, 0),)


def make(name: str) -> Draw:
    """A backend by name."""
    if name in ("gsplat", "gswarp"):
        if importlib.util.find_spec(name) is None:
            raise SystemExit(f"{name} is not installed: pip install {name}")
        return draw_gsplat if name == "gsplat" else draw_gswarp
    if name == "torch":
        from hoigs.rasterizers.torch_tiles import TorchRasterizer

        return ours(TorchRasterizer())
    if name == "oracle":
        from hoigs.rasterizers.oracle import OracleRasterizer

        return ours(OracleRasterizer(cutoffs=True))
    from hoigs.rasterizers.warp import WarpRasterizer

    kinds: dict[str, Any] = {
        "warp": WarpRasterizer(),
        "warp-openmp": WarpRasterizer(scheduler="openmp"),
        "warp-portable": WarpRasterizer(cpu_kernels="portable"),
    }
    if name not in kinds:
        raise SystemExit(
            f"no backend {name!r}; there are torch, oracle, {', '.join(kinds)}, gsplat and gswarp"
        )
    return ours(kinds[name])


def clock(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1e3 * time.perf_counter()


def once(draw: Draw, gaussians: Gaussians, camera: Camera) -> tuple[float, float, Tensor]:
    """Milliseconds forward and backward, and the picture."""
    leaves = gaussians.map(lambda x: x.detach().requires_grad_())
    start = clock(leaves.means.device)
    outputs = draw(leaves, camera)
    middle = clock(leaves.means.device)
    torch.autograd.backward(outputs, [torch.ones_like(x) for x in outputs])
    end = clock(leaves.means.device)
    return middle - start, end - middle, outputs[0].detach()


def case(
    draws: dict[str, Draw], gaussians: Gaussians, camera: Camera, repeats: int, seconds: float
) -> list[dict[str, Any]]:
    """Interleaved rounds, at most `repeats` and, after the third, `seconds`."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in draws}
    pictures = {name: once(draw, gaussians, camera)[2] for name, draw in draws.items()}
    began = time.perf_counter()
    for round_ in range(repeats):
        if round_ >= 3 and time.perf_counter() - began > seconds:
            break
        for name, draw in draws.items():
            times[name].append(once(draw, gaussians, camera)[:2])
    first = next(iter(draws))
    totals = {name: statistics.median(map(sum, rounds)) for name, rounds in times.items()}
    rows = []
    for name, rounds in times.items():
        difference = (pictures[name] - pictures[first]).abs().double().mean()
        rows.append(
            {
                "backend": name,
                "rounds": len(rounds),
                "forward_ms": round(statistics.median(x[0] for x in rounds), 3),
                "backward_ms": round(statistics.median(x[1] for x in rounds), 3),
                "total_ms": round(totals[name], 3),
                "fastest_ms": round(min(map(sum, rounds)), 3),
                f"times_{first}": round(totals[name] / totals[first], 3),
                "difference": float(difference),
            }
        )
    return rows


def machine(device: torch.device) -> dict[str, Any]:
    packages = ("torch", "warp-lang", "numpy", "hoigs", "gsplat", "gswarp")
    versions = {}
    for package in packages:
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
    parser.add_argument("--backends", nargs="+", default=["warp", "warp-openmp", "torch"])
    parser.add_argument("--scenes", nargs="+", default=["garden"], choices=["garden", "synthetic"])
    parser.add_argument("--sizes", nargs="+", default=["256x256", "512x512"])
    parser.add_argument("--counts", nargs="+", type=int, default=[5000, 20000])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=60, help="for one case, about")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()

    if "garden" in options.scenes and not GARDEN.exists():
        raise SystemExit(f"{GARDEN} is not there: use --scenes synthetic, or set HOIGS_SHARED")
    device = torch.device(options.device)
    report: dict[str, Any] = {"machine": machine(device), "cases": []}
    draws = {name: make(name) for name in options.backends}
    for scene in options.scenes:
        for size in options.sizes:
            width, height = map(int, size.split("x"))
            for count in options.counts:
                gaussians, camera = (garden if scene == "garden" else synthetic)(count)
                gaussians, camera = gaussians.to(device), camera.resized(width, height).to(device)
                rows = case(draws, gaussians, camera, options.repeats, options.seconds)
                for row in rows:
                    row = {"scene": scene, "size": size, "count": count, **row}
                    report["cases"].append(row)
                    print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    if options.out:
        partial = options.out.with_suffix(".partial")
        partial.write_text(json.dumps(report, indent=1))
        partial.replace(options.out)


if __name__ == "__main__":
    main()
