"""gsplat's own training loop with its `rasterization` and with hoigs', in turns.

    python benchmarks/gsplat_loop.py --device cuda --json benchmarks/results/gsplat-loop.json
    python benchmarks/gsplat_loop.py --device cpu --size 96x64 --cameras 4 --steps 60

A scene of random Gaussians is drawn from cameras around it, and fitted from a tenth of as many
points by gsplat's unmodified strategies and Adam. The loops differ in the import of `rasterization`
alone. Backends take turns, round by round; a round has its own seed. gsplat draws on CUDA only, and
its MCMCStrategy needs its compiled kernels: where these are missing, that is said, and only
`hoigs.gsplat` is measured.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from gsplat import DefaultStrategy, MCMCStrategy
from torch import Tensor

import hoigs.gsplat

Draw = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def cameras(count: int, width: int, height: int) -> tuple[Tensor, Tensor]:
    """On a circle around the origin, looking at it."""
    views = []
    for i in range(count):
        turn = 2 * math.pi * i / count
        back = torch.tensor([math.sin(turn), -0.3, math.cos(turn)])
        z = -torch.nn.functional.normalize(back, dim=0)
        x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1, 0]), z), dim=0)
        view = torch.eye(4)
        view[:3, :3] = torch.stack((x, torch.linalg.cross(z, x), z))
        view[2, 3] = 4.0
        views.append(view)
    focal = 1.1 * width
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return torch.stack(views), K.expand(count, 3, 3).contiguous()


def random_scene(count: int, generator: torch.Generator) -> dict[str, Tensor]:
    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    return {
        "means": rand(count, 3) * 2 - 1,
        "quats": torch.randn(count, 4, generator=generator),
        "scales": (0.01 + 0.04 * rand(count, 3)).log(),
        "opacities": torch.logit(0.2 + 0.7 * rand(count)),
        "sh0": rand(count, 1, 3) * 2 - 1,
        "shN": 0.1 * torch.randn(count, 15, 3, generator=generator),
    }


def image(
    draw: Draw, params: Any, view: Tensor, K: Tensor, size: tuple[int, int], **more: Any
) -> Any:
    return draw(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
        torch.cat((params["sh0"], params["shN"]), 1), view[None], K[None], *size,
        sh_degree=3, **more,
    )  # fmt: skip


def train(draw: Draw, args: argparse.Namespace, strategy_name: str, seed: int) -> dict[str, float]:
    """PSNR over all cameras, Gaussians and milliseconds a step of one training."""
    device, size = torch.device(args.device), args.size
    generator = torch.Generator().manual_seed(seed)
    truth = {k: v.to(device) for k, v in random_scene(args.gaussians, generator).items()}
    views, Ks = (x.to(device) for x in cameras(args.cameras, *size))
    with torch.no_grad():
        targets = [
            image(hoigs.gsplat.rasterization, truth, view, K, size)[0] for view, K in zip(views, Ks)
        ]
    start = random_scene(args.gaussians // 10, generator)
    start["sh0"], start["shN"] = torch.zeros_like(start["sh0"]), torch.zeros_like(start["shN"])
    params = torch.nn.ParameterDict({k: v.to(device) for k, v in start.items()})
    rates = {
        "means": 2e-3,
        "quats": 1e-3,
        "scales": 5e-3,
        "opacities": 5e-2,
        "sh0": 5e-3,
        "shN": 2e-4,
    }
    optimizers = {k: torch.optim.Adam([params[k]], lr=rate) for k, rate in rates.items()}
    torch.manual_seed(seed)
    if strategy_name == "default":
        strategy: Any = DefaultStrategy(
            refine_start_iter=args.steps // 10, refine_every=max(args.steps // 20, 5),
            refine_stop_iter=args.steps * 3 // 4, reset_every=10 * args.steps,
        )  # fmt: skip
        state = strategy.initialize_state(scene_scale=1.0)
    else:
        strategy = MCMCStrategy(
            cap_max=args.gaussians, refine_start_iter=args.steps // 10,
            refine_every=max(args.steps // 20, 5), refine_stop_iter=args.steps * 3 // 4,
        )  # fmt: skip
        state = strategy.initialize_state()
    strategy.check_sanity(params, optimizers)
    began = 0.0
    for step in range(args.steps):
        if step == args.steps // 10:  # compiled and warm
            _wait(device)
            began = time.perf_counter()
        i = step * 7 % args.cameras
        drawn, _, info = image(draw, params, views[i], Ks[i], size, packed=False)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        (drawn - targets[i]).abs().mean().backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if strategy_name == "default":
            # the strategy reads the gradient of info["means2d"], which zero_grad does not touch
            strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        else:
            strategy.step_post_backward(params, optimizers, state, step, info, lr=rates["means"])
    _wait(device)
    ms = 1000 * (time.perf_counter() - began) / (args.steps - args.steps // 10)
    with torch.no_grad():
        errors = [
            (image(draw, params, view, K, size)[0] - target).square().mean()
            for view, K, target in zip(views, Ks, targets)
        ]
    psnr = -10 * torch.stack(errors).mean().log10().item()
    return {"psnr": psnr, "gaussians": len(params["means"]), "ms": ms}


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def backends(device: str) -> dict[str, Draw]:
    found: dict[str, Draw] = {"hoigs.gsplat": hoigs.gsplat.rasterization}
    if device == "cuda":
        from gsplat import rasterization

        found["gsplat"] = rasterization
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--size", default="640x480", help="width x height")
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--cameras", type=int, default=24)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--strategies", nargs="+", default=["default", "mcmc"])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    args.size = tuple(int(x) for x in args.size.split("x"))
    rows: list[dict[str, Any]] = []
    for strategy in args.strategies:
        for seed in range(args.rounds):
            for name, draw in backends(args.device).items():
                try:
                    row: dict[str, Any] = train(draw, args, strategy, seed)
                except (ImportError, AttributeError, RuntimeError, TypeError) as error:
                    row = {"error": f"{type(error).__name__}: {error}"[:300]}
                rows.append({"backend": name, "strategy": strategy, "seed": seed, **row})
                print(json.dumps(rows[-1]), flush=True)
        for name in backends(args.device):
            good = [
                r for r in rows if r["backend"] == name and r["strategy"] == strategy and "ms" in r
            ]
            if good:
                medians = {
                    k: statistics.median(r[k] for r in good) for k in ("psnr", "gaussians", "ms")
                }
                print(f"{strategy} {name}: {medians}", flush=True)
    if args.json:
        about = {"device": args.device, "torch": torch.__version__, "size": args.size}
        if args.device == "cuda":
            about["gpu"] = torch.cuda.get_device_name()
        args.json.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
