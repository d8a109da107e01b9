"""Whether two trainings from the same seed end with the same bits, and where they part if not.

    python benchmarks/repeats.py --specs hoigs hold-gs hosnerf-gs hugs --json repeats.json

Both trainings of a spec run in this process, on a built-in clip. Exit code 1 if any two differ.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.at_size import machine, write
from hoigs.training.session import Session

CLIP = (
    "builtin:lift-and-swing?width=256&height=256&frames=16&fps=4&samples=1&edge_samples=1"
    "&held_out_views=0&test_frames=2&scene_points=20000&object_points=2000"
)


def trained(
    spec: str, steps: int, device: str, settings: list[str]
) -> tuple[list[float], dict[str, torch.Tensor]]:
    """The loss of every step, and all that the model has at the end, on the CPU."""
    losses: list[float] = []
    with tempfile.TemporaryDirectory() as scratch:
        session = Session.open(
            CLIP, spec, out=Path(scratch) / "run", device=device, overwrite=True,
            overrides=[
                f"train.steps={steps}", "train.log_every=1", "train.preview_every=0", *settings
            ],
        )  # fmt: skip
        session.trainer.train(on_step=lambda report: losses.append(report.loss))
        state = session.trainer.model.state_dict()
    return losses, {name: x.cpu() for name, x in state.items() if isinstance(x, torch.Tensor)}


def compared(spec: str, steps: int, device: str, settings: list[str]) -> dict[str, Any]:
    (first, one), (second, other) = (trained(spec, steps, device, settings) for _ in range(2))
    apart = [i + 1 for i, (a, b) in enumerate(zip(first, second, strict=True)) if a != b]
    names = [name for name in one if name not in other or not torch.equal(one[name], other[name])]
    return {
        "spec": spec,
        "first_step_whose_loss_differs": apart[0] if apart else None,
        "tensors": len(one),
        "tensors_that_differ": names,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--specs", nargs="+", default=["hoigs", "hold-gs", "hosnerf-gs", "hugs"])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--set", dest="settings", nargs="*", default=[], help="of every spec")
    parser.add_argument("--json", type=Path, help="where the findings are written")
    options = parser.parse_args()
    found = []
    for spec in options.specs:
        found.append(compared(spec, options.steps, options.device, options.settings))
        step, names = found[-1]["first_step_whose_loss_differs"], found[-1]["tensors_that_differ"]
        print(
            f"{spec}: all {found[-1]['tensors']} tensors are equal after {options.steps} steps"
            if not names
            else f"{spec}: {len(names)} tensors differ, the loss from step {step} on",
            flush=True,
        )
    device = torch.device(options.device)
    write({"machine": machine(device), "steps": options.steps, "specs": found}, options.json)
    return int(any(row["tensors_that_differ"] for row in found))


if __name__ == "__main__":
    sys.exit(main())
