"""Whether one scene trains faster on two GPUs: a view a step on each, gradients added up.

    python benchmarks/one_scene_two_gpus.py --json benchmarks/results/one-scene-two-gpus.json
    python benchmarks/one_scene_two_gpus.py --device cpu --size 64x36 --splats 500 200 80 --steps 6

Compared are views a second: of steps of one view on one GPU, as `hoigs train` has them; of steps of
two views there, whose gradients add up before the optimizer's step; and of the same steps with a
view on each GPU, all parameters' gradients summed by one all-reduce (NCCL, gloo on CPUs). Density
control is off, so that both keep the same Gaussians.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.at_size import (
    Size,
    add_size,
    clip_name,
    clock,
    machine,
    middle,
    spec_overrides,
    write,
)
from hoigs.training.session import Session
from hoigs.training.trainer import Trainer

FRAMES, BLOCKS, WARMUP = 16, 8, 20
WAYS = ("one view a step", "two views a step", "a view on each of two")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_size(parser)
    parser.add_argument("--steps", type=int, default=240, help="views of each way")
    parser.add_argument("--least", type=float, default=1.6, help="times, to be worth having")
    options = parser.parse_args()
    torch.set_num_threads(max(1, torch.get_num_threads() // 2))
    found = {way: measured(options, way, 0) for way in WAYS[:2]}
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        mp.spawn(_rank, (options, port, folder), nprocs=2)
        found[WAYS[2]] = json.loads(Path(folder, "0.json").read_text())
    best = max(found[way]["views_per_s"] for way in WAYS[:2])
    report = {
        "machine": machine(torch.device(options.device)), "size": options.size,
        "splats": list(options.splats), "ways": found,
        "times": round(found[WAYS[2]]["views_per_s"] / best, 3),
    }  # fmt: skip
    for way, row in found.items():
        print(f"{way:24} {row['views_per_s']:8.2f} views/s  {row['step_ms']:8.2f} ms a step")
    print(f"two against one: {report['times']} times; worth having from {options.least}")
    write(report, options.json)
    return int(report["times"] < options.least)


def _rank(rank: int, options: argparse.Namespace, port: int, folder: str) -> None:
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    cuda = options.device.startswith("cuda")
    if cuda:
        torch.cuda.set_device(rank)
    dist.init_process_group("nccl" if cuda else "gloo", rank=rank, world_size=2)
    try:
        row = measured(options, WAYS[2], rank)
        Path(folder, f"{rank}.json").write_text(json.dumps(row))
    finally:
        dist.destroy_process_group()


def measured(options: argparse.Namespace, way: str, rank: int) -> dict[str, float]:
    """Views a second of one way, median of blocks."""
    size, views = Size.parse(options.size), 2 if way == WAYS[1] else 1
    total = 2 * (options.steps + WARMUP * views)
    settings = [
        f"train.steps={total}", f"train.checkpoint_every={10 * total}",
        f"train.log_every={10 * total}", "train.preview_every=0",
        *(f"train.warmup.{part}=0" for part in ("motion", "interaction", "poses", "cameras")),
    ]  # fmt: skip
    device = f"cuda:{rank}" if options.device.startswith("cuda") else options.device
    with tempfile.TemporaryDirectory() as scratch:
        session = Session.open(
            clip_name(size.width, size.height, FRAMES, tuple(options.splats)), "hoigs",
            out=Path(scratch) / "run",
            overrides=spec_overrides(tuple(options.splats), [*settings, *options.overrides]),
            device=device, overwrite=True,
        )  # fmt: skip
        trainer = session.trainer
        trainer.density = {}
        trainer.generator.manual_seed(rank)
        list(session.clip)  # decoded and kept
        if way == WAYS[1]:
            _accumulate(trainer, views)
        elif way == WAYS[2]:
            _add_up(trainer)
        each = max(1, options.steps // (BLOCKS * views)) * views
        trainer.train(until=WARMUP * views)
        spent = []
        for _ in range(BLOCKS):
            began = clock(trainer.model.device)
            trainer.train(until=trainer.step + each)
            spent.append((clock(trainer.model.device) - began) / each)
    a_view = middle(spent)
    together = 2 if way == WAYS[2] else 1
    return {"views_per_s": round(1e3 * together / a_view, 3), "step_ms": round(a_view * views, 3)}


def _accumulate(trainer: Trainer, views: int) -> None:
    """The optimizer steps after `views` views, on the sum of their gradients."""
    step, zero = trainer.optimizer.step, trainer.optimizer.zero_grad

    def stepped(degree: int | None = None) -> None:
        if trainer.step % views == 0:
            step(degree)

    def cleared() -> None:
        if trainer.step % views == 1:
            zero()

    patched: Any = trainer.optimizer
    patched.step, patched.zero_grad = stepped, cleared


def _add_up(trainer: Trainer) -> None:
    """The optimizer steps on the sum of all processes' gradients."""
    step = trainer.optimizer.step
    parameters = [p for p in trainer.model.parameters() if p.requires_grad]

    def stepped(degree: int | None = None) -> None:
        for p in parameters:
            if p.grad is None:  # not seen by this view, but maybe by the other
                p.grad = torch.zeros_like(p)
        flat = torch.cat([p.grad.reshape(-1) for p in parameters if p.grad is not None])
        dist.all_reduce(flat)
        start = 0
        for p in parameters:
            assert p.grad is not None
            p.grad.copy_(flat[start : start + p.numel()].view_as(p))
            start += p.numel()
        step(degree)

    patched: Any = trainer.optimizer
    patched.step = stepped


if __name__ == "__main__":
    sys.exit(main())
