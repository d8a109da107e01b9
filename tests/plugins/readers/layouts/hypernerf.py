"""A clip as a Nerfies / HyperNeRF capture: the original world, and scene.json that scales it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from layouts.common import save_image, save_json

from hoigs.core.values.clip import Clip

SCALE, CENTER = 0.25, (0.4, -0.2, 1.5)


def raw(points: torch.Tensor) -> np.ndarray:
    """Points of the clip's world in the capture's: (x - center) * scale leads back."""
    return points.double().numpy() / SCALE + np.array(CENTER)


def write(clip: Clip, folder: Path, *, interp: bool = False, factors: tuple[int, ...] = (1,),
          camera: dict[str, Any] | None = None, depth: bool = True) -> None:  # fmt: skip
    """Cameras are at rgb/1x; rgb/2x has every second pixel.

    Args:
        interp: an empty val_ids, as in HyperNeRF's interp captures. camera: replaces keys.
    """
    names = [f"{i + 1:06d}" for i in range(len(clip))]
    for name, frame in zip(names, clip):
        K, w2c = frame.camera.K.double(), frame.camera.world_to_camera.double()
        center = -w2c[:3, :3].T @ w2c[:3, 3]
        for factor in factors:
            save_image(folder / f"rgb/{factor}x/{name}.png", frame.image[::factor, ::factor])
        save_json(folder / f"camera/{name}.json", {
            "orientation": w2c[:3, :3].tolist(),
            "position": raw(center).tolist(),
            "focal_length": float(K[0, 0]),
            "principal_point": [float(K[0, 2]), float(K[1, 2])],
            "skew": 0.0,
            "pixel_aspect_ratio": float(K[1, 1] / K[0, 0]),
            "radial_distortion": [0.0, 0.0, 0.0],
            "tangential_distortion": [0.0, 0.0],
            "image_size": [frame.camera.width, frame.camera.height],
            **(camera or {}),
        })  # fmt: skip
        if depth and frame.depth is not None:
            (folder / "depth/1x").mkdir(parents=True, exist_ok=True)
            np.save(folder / f"depth/1x/{name}.npy", frame.depth.numpy()[..., None] / SCALE)
    train, test = ([names[i] for i in clip.split[use]] for use in ("train", "test"))
    used = {"train_ids": [] if interp else train, "val_ids": [] if interp else test}
    save_json(folder / "dataset.json", {
        "count": len(names), "num_exemplars": len(used["train_ids"]), "ids": names, **used,
    })  # fmt: skip
    save_json(folder / "metadata.json", {
        name: {"warp_id": i, "appearance_id": i, "camera_id": 0} for i, name in enumerate(names)
    })  # fmt: skip
    save_json(
        folder / "scene.json", {"near": 0.1, "far": 2.0, "scale": SCALE, "center": list(CENTER)}
    )
    np.save(folder / "points.npy", raw(clip.points))
