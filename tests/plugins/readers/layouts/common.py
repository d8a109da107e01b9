"""What the writers of layouts share: pixels of a clip to files, and OpenCV poses to OpenGL."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from hoigs.core.model.smpl_params import KNUCKLES
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose


def save_image(path: Path, pixels: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(pixels)).save(path)


def save_mask(path: Path, mask: torch.Tensor, inside: int = 255, outside: int = 0) -> None:
    save_image(path, np.where(mask.numpy(), inside, outside).astype(np.uint8))


def save_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2), encoding="utf-8")


def opengl_pose(camera: Camera) -> list[list[float]]:
    """Camera-to-world with OpenGL axes: x right, y up, z backward."""
    c2w = torch.linalg.inv(camera.world_to_camera.double())
    c2w[:3, 1:3] *= -1
    return c2w.tolist()


def save_ply(path: Path, points: torch.Tensor, colors: torch.Tensor, floats: bool = False) -> None:
    """Binary PLY as 3DGS's storePly writes it (`floats`: colours 0..255 as floats), or bytes."""
    kind = "f4" if floats else "u1"
    fields = [(n, "f4") for n in ("x", "y", "z", "nx", "ny", "nz")]
    rows = np.zeros(len(points), [*fields, *((n, kind) for n in ("red", "green", "blue"))])
    for axis, (place, tint) in enumerate((("x", "red"), ("y", "green"), ("z", "blue"))):
        rows[place] = points[:, axis].numpy()
        rows[tint] = (255 * colors[:, axis]).round().numpy()
    named = {"f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {named[rows.dtype[n].str[1:]]} {n}" for n in rows.dtype.names or ()]
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + rows.tobytes())


def smpl_pose(pose: BodyPose) -> torch.Tensor:
    """The 72 numbers of SMPL for a pose whose fingers are straight: one joint a hand."""
    hands = torch.stack((pose.left_hand, pose.right_hand), -3)[..., KNUCKLES[1], :]
    first = torch.cat((pose.global_orient[..., None, :], pose.body), -2)
    return torch.cat((first, hands), -2).flatten(-2)
