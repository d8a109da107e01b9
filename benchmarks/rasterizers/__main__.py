"""Command line of the rasterizer benchmark; what is measured stands in the package's docstring."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch

import benchmarks.rasterizers as package
from benchmarks.rasterizers import chart, machine, timing
from benchmarks.rasterizers.peers import Peer, all_peers
from benchmarks.rasterizers.scenes import GARDEN, Case, build

CPU_PEERS = ["warp", "warp-openmp", "torch", "oracle", "gsplat-torch"]
CUDA_PEERS = ["warp", "warp-captured", "gsplat", "gswarp"]
CPU_CASES = [
    f"{size}/{count}"
    for size in ("256x256", "512x512", "1280x720")
    for count in (5_000, 20_000, 100_000)
]
ORACLE_CASE = "64x64/1000"
CUDA_CASES = ["512x512/20000", "1280x720/20000", "1280x720/50000", "1280x720/111785"]
CUDA_CASES += ["1920x1080/111785"]
MORE_GAUSSIANS = [f"512x512/{count}" for count in (12_500, 25_000, 50_000, 100_000)]
MORE_PIXELS = [f"{size}/50000" for size in ("320x180", "320x360", "640x360", "640x720", "1280x720")]
PARTS = ("times", "growth", "stages", "memory")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rasterizers",
        description=package.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--date", default="not given", help="written into the report")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--peers", nargs="+", help=f"default: {CPU_PEERS}, on CUDA {CUDA_PEERS}")
    parser.add_argument("--cases", nargs="+", help="such as 512x512/20000")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--scene", choices=["garden", "synthetic"], default="garden")
    parser.add_argument("--garden", type=Path, default=GARDEN, help="gsplat's garden.npz")
    parser.add_argument("--sh-degree", type=int, default=3)
    parser.add_argument("--rounds", type=int, help="default: 15, on CUDA 50")
    parser.add_argument("--seconds", type=float, default=60, help="for one case, about")
    parser.add_argument("--out", type=Path, help="without suffix; default benchmarks/results/...")
    return parser.parse_args()


def series(
    options: argparse.Namespace, peers: list[Peer], cases: list[str], device: torch.device
) -> list[dict[str, Any]]:
    rows = []
    for case in map(Case.parse, cases):
        scene = build(options.scene, case, options.sh_degree, options.garden, device)
        rows += timing.compare(peers, case, scene, options.rounds, options.seconds, say)
    return rows


def say(line: str) -> None:
    print(line, flush=True)


def run(options: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    known = all_peers()
    unknown = [name for name in options.peers if name not in known]
    if unknown:
        raise SystemExit(f"no peer {unknown[0]!r}; there are {', '.join(known)}")
    peers = [known[name]() for name in options.peers]
    report: dict[str, Any] = {
        "date": options.date,
        "machine": machine.describe(device),
        "scene": {"name": options.scene, "sh_degree": options.sh_degree},
        "peers": {peer.name: {"note": peer.note, **peer.versions} for peer in peers},
    }
    if "times" in options.only:
        quick = [peer for peer in peers if peer.name != "oracle"]
        report["times"] = series(options, quick, options.cases, device)
        if len(quick) < len(peers):  # the oracle draws tiny pictures only
            report["tiny"] = series(options, peers, [ORACLE_CASE], device)
    if "growth" in options.only:
        first = peers[:1]
        report["growth"] = {
            what: timing.growth(series(options, first, cases, device), first[0].name)
            for what, cases in (("gaussians", MORE_GAUSSIANS), ("pixels", MORE_PIXELS))
        }
        for what, factors in report["growth"].items():
            text = ", ".join(f"{x['factor']} ({x['factor_cores']})" for x in factors)
            say(f"twice the {what}: {text} by the clock (by the cores' time)")
    if device.type == "cpu" and {"stages", "memory"} & set(options.only):
        report |= inside(options)
    return report


def inside(options: argparse.Namespace) -> dict[str, Any]:
    """Stages and memory of our native CPU kernels."""
    from benchmarks.rasterizers import limits, memory, stages

    device, report = torch.device("cpu"), {}
    scenes = [
        (case, *build(options.scene, case, options.sh_degree, options.garden, device))
        for case in map(Case.parse, options.cases)
    ]
    if "stages" in options.only:
        report["limits"] = limits.measure(torch.get_num_threads())
        say("limits: " + ", ".join(f"{name} {x:.3g}" for name, x in report["limits"].items()))
        report["stages"] = {}
        for case, gaussians, camera in scenes:
            found = stages.measure(gaussians, camera, report["limits"], options.rounds)
            report["stages"][str(case)] = found
            say(f"{case!s:18} " + ", ".join(f"{k} {v}" for k, v in found["milliseconds"].items()))
            parts = {name: x["fraction"] for name, x in found["of_limit"].items()}
            say(f"{'':18} of the limit: " + ", ".join(f"{k} {v:.0%}" for k, v in parts.items()))
    if "memory" in options.only:
        report["memory"] = memory.measure(scenes)
        say("memory: " + ", ".join(f"{k} {v}" for k, v in report["memory"].items() if k != "cases"))
    return report


def main() -> None:
    options = arguments()
    device = torch.device(options.device)
    cuda = device.type == "cuda"
    options.peers = options.peers or (CUDA_PEERS if cuda else CPU_PEERS)
    options.cases = options.cases or (CUDA_CASES if cuda else CPU_CASES)
    options.rounds = options.rounds or (50 if cuda else 15)
    if options.scene == "garden" and not options.garden.exists():
        raise SystemExit(f"{options.garden} is not there: use --garden or --scene synthetic")
    results = Path(__file__).parents[1] / "results"
    out = options.out or results / f"rasterizers-{device.type}"
    report = run(options, device)
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_suffix(".partial")
    partial.write_text(json.dumps(report, indent=1) + "\n")
    partial.replace(out.with_suffix(".json"))
    say(f"{out.with_suffix('.json')}")
    if "times" in report:
        chart.draw(report, out.with_suffix(".png"))
        say(f"{out.with_suffix('.png')}")


if __name__ == "__main__":
    main()
