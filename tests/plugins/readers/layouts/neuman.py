"""A clip as a NeuMan scene: images/, sparse/, segmentations/, SMPL by joblib, alignments.npy, …"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from layouts.colmap_text import write_model
from layouts.common import save_image, save_mask, smpl_pose

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.values.clip import Clip


def write(
    clip: Clip,
    folder: Path,
    body: BodyModel,
    *,
    units: float = 0.4,
    scales: Sequence[float] | None = None,
    depth: bool = True,
    **model: Any,
) -> None:
    """As the authors' preparation leaves it.

    Args:
        body: whose pelvis stands in for SMPL's. units: COLMAP units in a metre.
        scales: of each frame's body against its true size: seen from the camera it looks alike.
    """
    import joblib

    names = [f"{i:05d}.png" for i in range(len(clip))]
    write_model(folder / "sparse", clip.cameras, names, clip.points, clip.point_colors,
                scale=units, **model)  # fmt: skip
    for name, frame in zip(names, clip):
        save_image(folder / "images" / name, frame.image)
        save_mask(folder / "segmentations" / name, frame.masks["human"], inside=0, outside=255)
        if depth and frame.depth is not None:
            save_mvs_depth(folder / f"depth_maps/{name}.geometric.bin", units * frame.depth.numpy())
    save_smpl(clip, body, units, list(scales or [1.0] * len(clip)), names, folder, joblib.dump)
    rooms = {"train": clip.split["train"], "test": clip.split["test"][:1],
             "val": clip.split["test"][1:]}  # fmt: skip
    for use, positions in rooms.items():
        lines = "".join(f"{names[i]}\n" for i in positions)
        (folder / f"{use}_split.txt").write_text(lines)


def save_smpl(clip: Clip, body: BodyModel, units: float, scales: list[float], names: list[str],
              folder: Path, dump: Any) -> None:  # fmt: skip
    """Poses turned against the world by a rotation of their own each frame, and no translation."""
    pose = clip.bodies["human"].poses.to(torch.float64)
    pelvis = body.shaped(pose.betas)[1][0].detach().double()
    turns = axis_angle_to_matrices(
        torch.randn(len(clip), 3, generator=torch.Generator().manual_seed(0)).double()
    )
    orient = matrices_to_axis_angle(turns.mT @ axis_angle_to_matrices(pose.global_orient))
    vectors = smpl_pose(pose.replace(global_orient=orient)).float().numpy()
    betas = pose.betas[:10].float().numpy()
    people = {"pose": list(vectors), "betas": [betas for _ in names]}
    dump({1: people}, folder / "smpl_output_optimized.pkl")
    alignments = {}
    for i, name in enumerate(names):
        w2c = clip.cameras[i].world_to_camera.double()
        eye = -w2c[:3, :3].T @ w2c[:3, 3]
        # x = R (v - J) + J + transl in metres; then about the eye by the frame's scale
        shift = pose.transl[i] + pelvis - turns[i] @ pelvis
        shift = eye + scales[i] * (shift - eye)
        rows = torch.cat((scales[i] * turns[i].mT, shift[None])) * units
        alignments[name] = rows.numpy()
    np.save(folder / "alignments.npy", np.array(alignments, dtype=object))


def save_mvs_depth(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + depth.astype("<f4").tobytes())
