"""A clip as a HOSNeRF scene: images/, masks/, cameras.pkl, mesh_infos.pkl, poses_bounds.npy, …"""

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from layouts.common import save_image, save_mask, smpl_pose

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.clip import Clip


def write(
    clip: Clip,
    folder: Path,
    body: BodyModel,
    *,
    units: float = 0.37,
    order: Sequence[int] | None = None,
    object_masks: bool = False,
    distortions: Sequence[float] | None = None,
    centred: bool = True,
) -> None:
    """As the authors' preparation leaves it.

    Args:
        body: whose joints stand in for SMPL's. units: COLMAP units in a metre.
        order: of the keys in the dictionaries. centred: joints about the pelvis, as HumanNeRF's
            preparation for videos writes them; else as SMPL gives them.
    """
    names = [f"{i:06d}" for i in range(len(clip))]
    pose = clip.bodies["human"].poses.to(torch.float64)
    vectors = smpl_pose(pose)
    rest = body.shaped(pose.betas)[1].detach().double()
    joints = rest[[*range(22), 25, 40]].numpy()
    cameras, meshes, rows = {}, {}, []
    # SMPL's space of a frame is turned and moved against the world, and in metres
    generator = torch.Generator().manual_seed(0)
    for i, name in enumerate(names):
        spin = axis_angle_to_matrices(torch.randn(3, generator=generator).double()).numpy()
        slide = torch.randn(3, generator=generator).double().numpy()
        w2c = clip.cameras[i].world_to_camera.double().numpy()
        K = clip.cameras[i].K.double().numpy()
        to_metres = np.eye(4)
        to_metres[:3, :3], to_metres[:3, 3] = spin, slide
        to_world = np.diag([units, units, units, 1.0]) @ to_metres
        cameras[name] = {
            "intrinsics": K,
            "smpl_to_camera": w2c @ to_metres,
            "smpl_to_world": to_world,
        }
        if distortions is not None:
            cameras[name]["distortions"] = np.array(distortions)
        orient = axis_angle_to_matrices(pose.global_orient[i]).numpy()
        pelvis = (rest[0] + pose.transl[i]).numpy()
        inner = spin.T @ orient
        own = joints - joints[0] if centred else joints
        place = spin.T @ (pelvis - slide)
        meshes[name] = {
            "Rh": _rotvec(inner),
            "Th": place - inner @ own[0],
            "poses": np.concatenate((np.zeros(3), vectors[i, 3:].numpy())),
            "tpose_joints": own,
            "joints": own,
        }
        c2w = np.linalg.inv(w2c)
        axes = np.stack((c2w[:3, 1], c2w[:3, 0], -c2w[:3, 2]), -1)  # down, right, back
        height, width = clip.cameras[i].height, clip.cameras[i].width
        llff = np.c_[axes, units * c2w[:3, 3], [height, width, K[0, 0]]]
        rows.append(np.concatenate((llff.ravel(), [0.8 * units, 9.0 * units])))
        frame = clip[i]
        save_image(folder / "images" / f"{name}.png", frame.image)
        union = frame.masks["human"] | frame.masks["object"]
        save_mask(folder / "masks" / f"{name}.png", union)
        if object_masks:
            save_mask(folder / "object_masks" / f"{name}.png", frame.masks["object"])
    chosen = [names[i] for i in order or range(len(names))]
    for path, table in (("cameras.pkl", cameras), ("mesh_infos.pkl", meshes)):
        (folder / path).write_bytes(pickle.dumps({n: table[n] for n in chosen}))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    (folder / "canonical_joints.pkl").write_bytes(pickle.dumps({"joints": joints}))
    states = {names[len(names) // 2]: {"time": 0.5}}
    (folder / "transitions_times.json").write_text(json.dumps(states))


def _rotvec(matrix: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_rotvec()
