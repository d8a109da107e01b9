"""A clip as an ExAvatar folder: frames/, masks/, frame lists, sparse/ or cam_params/, SMPL-X."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from layouts.colmap_text import write_model
from layouts.common import save_image, save_json, save_mask

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.model.smpl_params import moved_pose
from hoigs.core.values.clip import Clip


def write(
    clip: Clip,
    folder: Path,
    body: BodyModel,
    *,
    virtual: bool = False,
    neuman: bool = False,
    step: int = 1,
    points: bool = True,
    **model: Any,
) -> None:
    """As the authors' fitting leaves it; SMPL-X in each frame's camera, flat hands.

    Args:
        body: whose pelvis stands in for SMPL-X's. virtual: cam_params/ in place of sparse/.
        neuman: the layout of ExAvatar's NeuMan.py. step: between frame numbers.
        points: sparse/points3D.txt; else bkg_point_cloud.txt.
    """
    numbers = [step * i for i in range(len(clip))]
    image = (lambda n: f"images/{n:05d}.png") if neuman else (lambda n: f"frames/{n}.png")
    for number, frame in zip(numbers, clip):
        save_image(folder / image(number), frame.image)
        stem = Path(image(number)).stem
        save_mask(folder / f"masks/{stem}.png", frame.masks["human"])
    save_cameras(clip, folder, numbers, virtual, points, neuman, **model)
    save_poses(clip, folder, numbers, body, "smplx_params" if neuman else "smplx_params_smoothed")
    for use in ("train", "test"):
        chosen = [numbers[i] for i in clip.split[use]]
        if neuman:
            lines = [f"{n:05d}.png" for n in chosen]
            (folder / f"{use}_split.txt").write_text("\n".join(lines) + "\n")
        else:
            (folder / f"frame_list_{use}.txt").write_text("\n".join(map(str, chosen)) + "\n")
    if not neuman:
        (folder / "frame_list_all.txt").write_text("\n".join(map(str, numbers)) + "\n")


def save_cameras(clip: Clip, folder: Path, numbers: list[int], virtual: bool, points: bool,
                 neuman: bool, **model: Any) -> None:  # fmt: skip
    if virtual:
        for number, camera in zip(numbers, clip.cameras):
            K, w2c = camera.K.double(), camera.world_to_camera.double()
            save_json(folder / f"cam_params/{number}.json", {
                "R": w2c[:3, :3].tolist(), "t": w2c[:3, 3].tolist(),
                "focal": [float(K[0, 0]), float(K[1, 1])],
                "princpt": [float(K[0, 2]), float(K[1, 2])],
            })  # fmt: skip
    else:
        names = [f"{n:05d}.png" if neuman else f"image{n}.png" for n in numbers]
        write_model(folder / "sparse", clip.cameras, names, clip.points, clip.point_colors, **model)
        if not points:
            (folder / "sparse/points3D.txt").unlink()
    if virtual or not points:
        rows = np.concatenate((clip.points.numpy(), 255 * clip.point_colors.numpy()), 1)
        np.savetxt(folder / "bkg_point_cloud.txt", rows, fmt="%.9g")


def save_poses(clip: Clip, folder: Path, numbers: list[int], body: BodyModel, room: str) -> None:
    pose = clip.bodies["human"].poses.to(torch.float64)
    pelvis = body.shaped(pose.betas)[1][0].detach().double()
    w2c = torch.stack([c.world_to_camera for c in clip.cameras]).double()
    seen = moved_pose(pose, pelvis, w2c[:, :3, :3], w2c[:, :3, 3])
    zeros = [0.0, 0.0, 0.0]
    for i, number in enumerate(numbers):
        save_json(folder / f"smplx_optimized/{room}/{number}.json", {
            "root_pose": seen.global_orient[i].tolist(),
            "body_pose": seen.body[i].tolist(),
            "jaw_pose": zeros, "leye_pose": zeros, "reye_pose": zeros,
            "lhand_pose": seen.left_hand[i].tolist(),
            "rhand_pose": seen.right_hand[i].tolist(),
            "expr": [0.0] * 50,
            "trans": seen.transl[i].tolist(),
        })  # fmt: skip
    betas = torch.cat((pose.betas, torch.zeros(100 - len(pose.betas))))
    save_json(folder / "smplx_optimized/shape_param.json", betas.tolist())
    save_json(folder / "smplx_optimized/joint_offset.json", [zeros] * 55)
