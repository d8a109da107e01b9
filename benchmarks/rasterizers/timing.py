"""Interleaved rounds, and their medians and ratios."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.rasterizers.peers import NotMeasuredError, Peer, Round
from benchmarks.rasterizers.scenes import Case
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians


def clock(device: torch.device) -> float:
    """Milliseconds, once the device has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1e3 * time.perf_counter()


class Sample(NamedTuple):
    """Milliseconds of one round: by the clock, and of all cores together (spinning included)."""

    forward: float
    backward: float
    cores: float

    @property
    def total(self) -> float:
        return self.forward + self.backward


def once(round_: Round, device: torch.device) -> tuple[Sample, Tensor]:
    """Times of one forward and one backward, and the picture."""
    cores = time.process_time()
    start = clock(device)
    picture = round_.forward()
    middle = clock(device)
    if round_.backward is not None:
        round_.backward()
    end = clock(device)
    return Sample(middle - start, end - middle, 1e3 * (time.process_time() - cores)), picture


def peak_bytes(round_: Round, device: torch.device) -> int:
    """Most bytes of torch's CUDA allocator in one round, beside what is there before it."""
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    once(round_, device)
    return torch.cuda.max_memory_allocated(device) - before


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
    longer than a tenth of `seconds` is left to three rounds with the first peer at the end.
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
            sample, picture = once(round_, device)  # compiles, fills caches
            if sample.total <= 1000 * seconds:
                sample, picture = once(round_, device)
        except NotMeasuredError as reason:
            rows[peer.name]["not_measured"] = str(reason)
            say(f"{case!s:18} {peer.name:14} not measured: {reason}")
            continue
        ready[peer.name], pictures[peer.name] = round_, picture
        if sample.total > 100 * seconds:
            slow.add(peer.name)
    samples: dict[str, list[Sample]] = {name: [] for name in ready}
    began = time.perf_counter()
    first = next(iter(ready), None)
    for number in range(rounds):
        if number >= 3 and time.perf_counter() - began > seconds:
            break
        for name in ready:
            if name not in slow:
                samples[name].append(once(ready[name], device)[0])
    for _ in range(3 if slow else 0):
        for name in ready:
            if name == first or name in slow:
                samples[name].append(once(ready[name], device)[0])
    for name, times in samples.items():
        totals = [x.total for x in times]
        base = [x.total for x in samples[first]] if first else []
        rows[name] |= {
            "forward_ms": spread([x.forward for x in times]),
            "backward_ms": spread([x.backward for x in times]) if ready[name].backward else None,
            "total_ms": spread(totals),
            "cores_ms": spread([x.cores for x in times]),
            f"times_{first}": round(statistics.median(totals) / statistics.median(base), 4),
            f"times_{first}_least": round(min(totals) / min(base), 4),
            f"times_{first}_cores": round(
                min(x.cores for x in times) / min(x.cores for x in samples[first or name]), 4
            ),
            "difference": float((pictures[name] - pictures[first]).abs().double().mean()),
        }
        row = rows[name]
        memory = ""
        if device.type == "cuda":
            row["peak_bytes"] = peak_bytes(ready[name], device)
            memory = f"  peak {row['peak_bytes'] / 1e6:.0f} MB"
        say(
            f"{case!s:18} {name:14} forward {row['forward_ms']['median']:9.2f}  total "
            f"{row['total_ms']['median']:9.2f} ms (least {row['total_ms']['least']:.2f})  "
            f"{row[f'times_{first}']:7.2f} x {first} (least {row[f'times_{first}_least']:.2f}, "
            f"cores {row[f'times_{first}_cores']:.2f})  "
            f"difference {row['difference']:.1e}{memory}"
        )
    return list(rows.values())


def growth(rows: list[dict[str, Any]], peer: str) -> list[dict[str, Any]]:
    """Factors of time from each case to the next, for rows of a series that doubles each time.

    `factor` is of the medians by the clock, `factor_cores` of the least time of all cores together,
    which says the same on a busy machine.
    """
    mine = [row for row in rows if row["peer"] == peer and "total_ms" in row]
    return [
        {
            "from": small["case"],
            "to": large["case"],
            "factor": round(large["total_ms"]["median"] / small["total_ms"]["median"], 3),
            "factor_least": round(large["total_ms"]["least"] / small["total_ms"]["least"], 3),
            "factor_cores": round(large["cores_ms"]["least"] / small["cores_ms"]["least"], 3),
        }
        for small, large in itertools.pairwise(mine)
    ]
