"""A COLMAP model in text, as `colmap model_converter --output_type TXT` writes it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from hoigs.core.maths.rotations import matrices_to_quats
from hoigs.core.values.camera import Camera


def write_model(
    folder: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    points: torch.Tensor,
    colors: torch.Tensor,
    *,
    lens: tuple[str, Sequence[float]] | None = None,
    scale: float = 1.0,
    order: Sequence[int] | None = None,
) -> None:
    """cameras.txt, images.txt and points3D.txt.

    Args:
        lens: COLMAP's model and parameters in place of the first camera's PINHOLE.
        scale: COLMAP units in a metre. order: in which images are listed and numbered.
    """
    folder.mkdir(parents=True, exist_ok=True)
    K = cameras[0].K.double()
    pinhole = [float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]
    model, params = lens or ("PINHOLE", pinhole)
    numbers = " ".join(repr(float(p)) for p in params)
    size = f"{cameras[0].width} {cameras[0].height}"
    (folder / "cameras.txt").write_text(f"# CAMERA_ID, MODEL, …\n1 {model} {size} {numbers}\n")
    lines = ["# two lines an image"]
    for number, i in enumerate(order or range(len(names)), start=1):
        w2c = cameras[i].world_to_camera.double()
        quat = matrices_to_quats(w2c[:3, :3])
        pose = " ".join(repr(float(v)) for v in (*quat, *(scale * w2c[:3, 3])))
        lines += [f"{number} {pose} 1 {names[i]}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    tints = np.round(255 * colors.numpy()).astype(int)
    for number, (place, tint) in enumerate(zip(scale * points.double(), tints), start=1):
        xyz, rgb = " ".join(repr(float(v)) for v in place), " ".join(map(str, tint))
        rows.append(f"{number} {xyz} {rgb} 0.5")
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
