"""Interleaved rounds, and what they come to."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.rasterizers.peers import NotMeasuredError, Peer, Round
from benchmarks.rasterizers.scenes import Case
from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians


def clock(device: torch.device) -> float:
    """Milliseconds, once all that was asked of the device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1e3 * time.perf_counter()


def once(round_: Round, device: torch.device) -> tuple[float, float, Tensor]:
    """Milliseconds forward and backward, and the picture."""
    start = clock(device)
    picture = round_.forward()
    middle = clock(device)
    if round_.backward is not None:
        round_.backward()
    return middle - start, clock(device) - middle, picture


def spread(samples: list[float]) -> dict[str, Any]:
    """Median, quartiles and least of some milliseconds, and all of them."""
    quarters = statistics.quantiles(samples, n=4, method="inclusive")
    return {
        "median": round(statistics.median(samples), 4),
        "quartiles": [round(quarters[0], 4), round(quarters[2], 4)],
        "least": round(min(samples), 4),
        "samples": [round(x, 4) for x in samples],
    }


def compare(
    peers: list[Peer],
    case: Case,
    scene: tuple[Gaussians, Camera],
    rounds: int,
    seconds: float,
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    """One row for each peer: times and the ratio to the first, or why there are none.

    At most `rounds` rounds, fewer once `seconds` have passed, but three. A peer whose round takes
    longer than a tenth of `seconds` runs in three of them.
    """
    gaussians, camera = scene
    device = gaussians.means.device
    rows: dict[str, dict[str, Any]] = {}
    ready: dict[str, Round] = {}
    pictures: dict[str, Tensor] = {}
    slow = set()
    for peer in peers:
        rows[peer.name] = {"case": str(case), "peer": peer.name}
        try:
            round_ = peer.prepare(gaussians, camera)
            once(round_, device)  # compiles, fills caches
            forward, backward, picture = once(round_, device)
        except NotMeasuredError as reason:
            rows[peer.name]["not_measured"] = str(reason)
            say(f"{case!s:18} {peer.name:14} not measured: {reason}")
            continue
        ready[peer.name], pictures[peer.name] = round_, picture
        if forward + backward > 100 * seconds:
            slow.add(peer.name)
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in ready}
    began = time.perf_counter()
    for number in range(rounds):
        if number >= 3 and time.perf_counter() - began > seconds:
            break
        for name, round_ in ready.items():
            if number < 3 or name not in slow:
                samples[name].append(once(round_, device)[:2])
    first = next(iter(ready), None)
    for name, times in samples.items():
        totals = [sum(x) for x in times]
        base = [sum(x) for x in samples[first]] if first else []
        rows[name] |= {
            "forward_ms": spread([x[0] for x in times]),
            "backward_ms": spread([x[1] for x in times]) if ready[name].backward else None,
            "total_ms": spread(totals),
            f"times_{first}": round(statistics.median(totals) / statistics.median(base), 4),
            f"times_{first}_least": round(min(totals) / min(base), 4),
            "difference": float((pictures[name] - pictures[first]).abs().double().mean()),
        }
        row = rows[name]
        say(
            f"{case!s:18} {name:14} forward {row['forward_ms']['median']:9.2f}  total "
            f"{row['total_ms']['median']:9.2f} ms (least {row['total_ms']['least']:.2f})  "
            f"{row[f'times_{first}']:7.2f} x {first} (least: {row[f'times_{first}_least']:.2f})  "
            f"difference {row['difference']:.1e}"
        )
    return list(rows.values())


def growth(rows: list[dict[str, Any]], peer: str) -> list[dict[str, Any]]:
    """Factors of time from each case to the next, for rows of a series that doubles each time."""
    times = [row["total_ms"] for row in rows if row["peer"] == peer and "total_ms" in row]
    cases = [row["case"] for row in rows if row["peer"] == peer and "total_ms" in row]
    return [
        {
            "from": cases[i],
            "to": cases[i + 1],
            "factor": round(times[i + 1]["median"] / times[i]["median"], 3),
            "factor_least": round(times[i + 1]["least"] / times[i]["least"], 3),
        }
        for i in range(len(times) - 1)
    ]
