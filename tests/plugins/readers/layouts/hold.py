"""A clip as a build folder of HOLD: image/, mask/, data.npy, corres.txt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from layouts.common import save_image

from hoigs.core.maths.rotations import matrices_to_axis_angle
from hoigs.core.values.clip import Clip

SCALE = 2.5  # of the normalised points
NORM = np.diag([4.0, 4.0, 4.0, 1.0])  # centres and scales COLMAP's points
NORM[:3, 3] = [0.5, -0.3, 0.2]


def write(clip: Clip, root: Path, *, tensor: bool = False, shrink: float = 0.3) -> Path:
    """The sequence's folder.

    Args:
        tensor: norm_mat as the torch tensor that build_dataset.py leaves. shrink: of scale_mat.
    """
    build = root / "hold_box_itw" / "build"
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # HOLD's world has OpenGL axes
    cameras: dict[str, Any] = {}
    for i, frame in enumerate(clip):
        K = np.eye(4)
        K[:3, :3] = frame.camera.K.double().numpy()
        w2c = frame.camera.world_to_camera.double().numpy()
        cameras[f"scale_mat_{i}"] = np.diag([shrink, shrink, shrink, 1.0]).astype(np.float32)
        cameras[f"world_mat_{i}"] = -3.0 * K @ w2c @ flip  # any scale and sign is the same camera
        save_image(build / "image" / f"{i:04d}.png", frame.image)
        ids = np.zeros(frame.image.shape[:2], np.uint8)
        ids[frame.masks["human"].numpy()] = 150
        ids[frame.masks["object"].numpy()] = 50
        save_image(build / "mask" / f"{i:04d}.png", ids)
    track = clip.objects["object"]
    turned = torch.from_numpy(flip[:3, :3])
    rotations = turned @ track.rotations.double()
    places = track.translations.double() @ turned.mT
    points = track.points.double().numpy() / SCALE
    cano = points @ NORM[:3, :3].T + NORM[:3, 3]
    norm = torch.from_numpy(NORM).float() if tensor else NORM
    hand = {
        "hand_poses": np.zeros((len(clip), 48)),
        "hand_trans": np.zeros((len(clip), 3)),
        "mean_shape": np.zeros(10),
    }
    thing = {
        "object_poses": np.c_[matrices_to_axis_angle(rotations).numpy(), places.numpy()],
        "obj_scale": SCALE, "norm_mat": norm, "pts.cano": cano,
    }  # fmt: skip
    data = {
        "seq_name": "hold_box_itw", "cameras": cameras, "scene_bounding_sphere": 6.0,
        "max_radius_ratio": 3.0, "entities": {"right": hand, "object": thing},
    }  # fmt: skip
    np.save(build / "data.npy", data, allow_pickle=True)
    (build / "corres.txt").write_text("".join(f"{i:05d}.png\n" for i in range(len(clip))))
    return build.parent
