"""The ports of examples/papers on a built-in clip, with and without what each brings: PSNR.

    python benchmarks/papers.py --out benchmarks/results/papers.json

Every training is of the same length and picture size; 20 minutes on a CPU that others use.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import Any

import torch

import hoigs

ROOT = Path(__file__).parents[1]
PAPERS = ROOT / "examples" / "papers"
STG, SOM = PAPERS / "spacetime_gaussians.py", PAPERS / "shape_of_motion.py"
# one set of Gaussians for the whole picture, at the rates of spacetime-gaussians.yaml
SAME = ("model.scene.points=20000", "model.scene.density.cap=auto", "model.scene.sh_degree=0",
        "train.sh_interval=null", "train.rates.sh=0.01", "train.rates.means=8e-4",
        "train.rates.means_final=8e-6")  # fmt: skip


def rows(tracks: Path) -> dict[str, tuple[str | Path, tuple[str, ...]]]:
    """Name to spec and settings."""
    stg, som = PAPERS / "spacetime-gaussians.yaml", PAPERS / "shape-of-motion.yaml"
    given = f"objectives.tracks.path={tracks}"
    return {
        "static 3DGS": ("static-3dgs", SAME),
        "SpacetimeGaussians, no decoder": (stg, ("decoder=null",)),
        "SpacetimeGaussians": (stg, ()),
        "Shape of Motion, no tracks": (som, (given, "objectives.tracks.weight=0")),
        "Shape of Motion": (som, (given,)),
        "4DGS": ("4dgs", (*SAME, "train.rates.planes=8e-3", "train.rates.networks=8e-4")),
    }


def scores(clip: str, spec: str | Path, settings: tuple[str, ...], out: Path) -> dict[str, float]:
    done = hoigs.train(
        clip, spec, out=out, plugins=[STG, SOM], device="cpu", overrides=settings
    )  # fmt: skip
    assert done.evaluated is not None
    evaluation, found = done.evaluated.evaluation, {}
    for view in ("test frames", "held-out cameras"):
        for region in ("full", "human_object"):
            score = evaluation.score(region, "psnr", view)
            assert isinstance(score, float)
            found[f"{view}, {region}"] = round(score, 2)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clip", default="builtin:carry")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    code = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        check=True,
        cwd=ROOT,
        capture_output=True,
        text=True,
    ).stdout.strip()
    found: dict[str, Any] = {"date": date.today().isoformat(), "code": code, "psnr": {}}
    found |= {"clip": options.clip, "steps": options.steps, "width": options.width}
    with tempfile.TemporaryDirectory() as folder:
        tracks = Path(folder) / "tracks.npz"
        torch.manual_seed(0)
        subprocess.run([sys.executable, str(SOM), options.clip, str(tracks)], check=True)
        for name, (spec, settings) in rows(tracks).items():
            length = (f"train.steps={options.steps}", f"train.width={options.width}")
            run = Path(folder) / name.replace(", ", "-").replace(" ", "-")
            found["psnr"][name] = scores(options.clip, spec, (*settings, *length), run)
            print(name, found["psnr"][name], flush=True)
            options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
