"""Scene points of a PLY or .npy file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import load_array

Points = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]
GREY = 0.5  # of points whose file has no colours


def read_points(path: Path) -> Points:
    """Points, and RGB in [0, 1] (grey where the file has none).

    Colours of a PLY are 0..255 whatever their type: 3DGS's writers store them as floats.

    Raises:
        ClipError: it cannot be read, or holds no points.
    """
    try:
        points, colors = _npy(path) if path.suffix == ".npy" else _ply(path)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise ClipError(f"{path} cannot be read as points ({error}); write it again") from error
    keep = np.isfinite(points).all(-1)
    if points.ndim != 2 or points.shape[1] != 3 or not keep.any():
        raise ClipError(f"{path} has shape {list(points.shape)}, expected some points [P, 3]")
    return torch.from_numpy(points[keep]).float(), torch.from_numpy(colors[keep]).float()


def _npy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    points = load_array(path)
    if not np.can_cast(points.dtype, np.float64, "same_kind"):
        raise ValueError(f"expected numbers, got {points.dtype}")
    points = points.astype(np.float64)
    return points, np.full_like(points, GREY)


def _ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    loaded: Any = trimesh.load(path, process=False)
    # trimesh assumes that float colours are in 0..1, so the raw values are read
    table = loaded.metadata["_ply_raw"]["vertex"]["data"]
    points = np.asarray(loaded.vertices, np.float64)
    named = table.dtype.names if isinstance(table, np.ndarray) else tuple(table)
    if not {"red", "green", "blue"} <= set(named):
        return points, np.full_like(points, GREY)
    channels = [np.asarray(table[c], np.float64).reshape(-1) for c in ("red", "green", "blue")]
    return points, np.clip(np.stack(channels, -1) / 255, 0, 1)
