"""hoigs at the size of the paper's figure: the clip, the spec and the splats of the speed scripts.

Splats are split as in trained runs of the built-in clip and of juggle: four fifths are the scene,
which density control has filled up, one sixth the person (a fixed number on the skin), the rest the
object. `--run` measures a trained model in their place. A model that has not been trained is given
opacities of 0.7 rather than 3DGS's 0.1, with which every ray would reach the background.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

SPLATS = (124_000, 26_000, 5_000)  # scene, human, object


def add_size(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--size", default="1280x720", help="pixels, WIDTHxHEIGHT")
    parser.add_argument(
        "--splats", nargs=3, type=int, default=SPLATS, metavar=("SCENE", "HUMAN", "OBJECT")
    )
    parser.add_argument("--set", dest="overrides", nargs="*", default=[], help="of the spec")
    parser.add_argument("--json", type=Path, help="where the figures are written")


@dataclass(frozen=True)
class Size:
    """Pixels of a picture."""

    width: int
    height: int

    @staticmethod
    def parse(text: str) -> Size:
        width, _, height = text.partition("x")
        return Size(int(width), int(height))


def clip_name(width: int, height: int, frames: int, splats: tuple[int, int, int]) -> str:
    """The built-in clip with enough points; two of its frames are for tests."""
    return (
        f"builtin:lift-and-swing?width={width}&height={height}&frames={frames}&fps={frames / 4}"
        "&samples=1&edge_samples=1&held_out_views=0&test_frames=2"
        f"&scene_points={splats[0]}&object_points={max(splats[2], 100)}"
    )


def spec_overrides(splats: tuple[int, int, int], more: list[str]) -> list[str]:
    """Settings of the spec "hoigs" that give so many splats."""
    names = ("scene", "human", "object")
    counts = [f"model.{n}.points={count}" for n, count in zip(names, splats, strict=True)]
    return [*counts, "model.scene.opacity=0.7", *more]


def clock(device: torch.device) -> float:
    """Time in milliseconds, after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1e3 * time.perf_counter()


def machine(device: torch.device) -> dict[str, Any]:
    import platform
    from importlib import metadata

    found = {}
    for package in ("torch", "warp-lang", "hoigs"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        **found,
    }


def middle(values: list[float]) -> float:
    return round(statistics.median(values), 4)


def write(report: dict[str, Any], path: Path | None) -> None:
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(report, indent=1) + "\n")
    partial.replace(path)
    print(path)
