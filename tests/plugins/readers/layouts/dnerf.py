"""A clip as a D-NeRF scene: transforms_{train,val,test}.json and RGBA pictures."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from layouts.common import opengl_pose, save_image, save_json

from hoigs.core.values.clip import Clip


def write(clip: Clip, folder: Path, *, val: bool = True, alpha: bool = False,
          seconds: float = 1.0) -> None:  # fmt: skip
    """Square pixels and a centred principal point are all that camera_angle_x can hold.

    Args:
        alpha: cut out human and object, the rest transparent. seconds: times the times.
    """
    rooms = {"train": clip.split["train"], "test": clip.split["test"]}
    if val:
        rooms["val"] = clip.split["test"][:1]
    for room, positions in rooms.items():
        frames = []
        for number, position in enumerate(positions):
            frame, name = clip[position], f"r_{number:03d}"
            seen = np.full((*frame.image.shape[:2], 1), 255, np.uint8)
            if alpha:
                seen[..., 0] = np.where(sum(frame.masks.values()).numpy() > 0, 255, 0)
            pixels = np.concatenate((frame.image.numpy(), seen), -1)
            save_image(folder / room / f"{name}.png", pixels)
            frames.append({
                "file_path": f"./{room}/{name}",
                "rotation": 0.0314,
                "time": seconds * frame.moment.time,
                "transform_matrix": opengl_pose(frame.camera),
            })  # fmt: skip
        camera = clip.cameras[0]
        angle = 2 * math.atan(0.5 * camera.width / float(camera.K[0, 0]))
        save_json(
            folder / f"transforms_{room}.json", {"camera_angle_x": angle, "frames": frames}
        )  # fmt: skip
