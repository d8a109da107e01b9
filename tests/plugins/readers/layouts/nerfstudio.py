"""A clip as a nerfstudio capture: transforms.json, images/, masks/, depth/, sparse_pc.ply."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from layouts.common import opengl_pose, save_image, save_json, save_mask, save_ply

from hoigs.core.values.clip import Clip


def write(clip: Clip, folder: Path, *, scale: float = 1.0, extras: bool = True,
          times: bool = True, lists: bool = True, ply: bool = True,
          lens: dict[str, Any] | None = None) -> None:  # fmt: skip
    """Masks mark human and object black, as what is not to be learned.

    Args:
        scale: applied_scale: of the camera places, not of depth and points.
        extras: masks and depth. times, lists: whether frames have times, and splits names.
        lens: keys that replace the first camera's intrinsics.
    """
    camera, frames = clip.cameras[0], []
    for frame in clip:
        name = f"frame_{frame.position + 1}.png"
        pose = torch.tensor(opengl_pose(frame.camera))
        pose[:3, 3] *= scale
        entry: dict[str, Any] = {
            "file_path": f"images/{name}",
            "transform_matrix": pose.tolist(),
            "colmap_im_id": frame.position + 1,
        }
        save_image(folder / "images" / name, frame.image)
        if times:
            entry["time"] = frame.moment.time
        if extras:
            moving = torch.stack(list(frame.masks.values())).any(0)
            save_mask(folder / "masks" / name, moving, inside=0, outside=255)
            assert frame.depth is not None
            save_image(
                folder / "depth" / name, (1000 * frame.depth.numpy()).round().astype(np.uint16)
            )
            entry |= {"mask_path": f"masks/{name}", "depth_file_path": f"depth/{name}"}
        frames.append(entry)
    content: dict[str, Any] = {
        "camera_model": "OPENCV",
        "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
        "w": camera.width, "h": camera.height,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "applied_scale": scale,
        "frames": frames[::-1],  # not the order of the names
        **(lens or {}),
    }  # fmt: skip
    if lists:
        for use, key in (("train", "train_filenames"), ("test", "val_filenames")):
            content[key] = [f"images/frame_{i + 1}.png" for i in clip.split[use]]
    if ply:
        content["ply_file_path"] = "sparse_pc.ply"
        save_ply(folder / "sparse_pc.ply", clip.points, clip.point_colors)
    save_json(folder / "transforms.json", content)
