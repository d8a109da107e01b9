"""The true body of a built-in clip in the files that GVHMR and WHAM write."""

from __future__ import annotations

import math
import pickle
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

SMPL_PELVIS, SMPLX_PELVIS = (-0.0018, -0.2233, 0.0282), (0.0031, -0.3514, 0.0120)  # mean shape


def write_bodies(
    clip: Any, body: Any, program: str, folder: Path, degrees: float = 0.0, cm: float = 0.0,
    seed: int = 0, frames: Sequence[int] | None = None,
) -> Path:  # fmt: skip
    """hmr4d_results.pt ("gvhmr") or wham_output.pkl ("wham"), as the program would have written it
    had it found the true pose, up to noise; GVHMR's intrinsics are the true ones.

    Args:
        degrees, cm: standard deviation of each joint's rotation and of the place, each frame.
        frames: that WHAM's person is in; None: all.
    """
    import torch

    from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle

    rng = np.random.default_rng(seed)
    poses = clip.bodies["human"].poses
    turn = torch.stack([c.world_to_camera[:3, :3] for c in clip.cameras])
    shift = torch.stack([c.world_to_camera[:3, 3] for c in clip.cameras])
    _, joints = body.shaped(poses.betas)
    pelvis = (turn @ (poses.transl + joints[0])[..., None])[..., 0] + shift
    turns = torch.cat((poses.global_orient[:, None], poses.body), 1)
    local = axis_angle_to_matrices(turns)
    local[:, 0] = turn @ local[:, 0]
    off = torch.from_numpy(rng.normal(size=turns.shape) * math.radians(degrees)).float()
    turns = matrices_to_axis_angle(local @ axis_angle_to_matrices(off))
    pelvis = pelvis + torch.from_numpy(rng.normal(size=pelvis.shape) * cm / 100).float()
    if program == "gvhmr":
        path = folder / "hmr4d_results.pt"
        params = {
            "body_pose": turns[:, 1:].flatten(1), "betas": torch.zeros(len(turns), 10),
            "global_orient": turns[:, 0], "transl": pelvis - torch.tensor(SMPLX_PELVIS),
        }  # fmt: skip
        K = torch.stack([c.K for c in clip.cameras])
        # "global" is in a world of GVHMR's own, which hoigs does not read
        torch.save(
            {"smpl_params_global": params, "smpl_params_incam": params, "K_fullimg": K}, path
        )
        return path
    # WHAM assumes a focal length, and a place at which the body is as large in the image
    width, height = clip.cameras[0].width, clip.cameras[0].height
    pelvis[:, 2] *= math.hypot(width, height) / torch.stack([c.K[0, 0] for c in clip.cameras])
    rows = np.arange(len(turns)) if frames is None else np.asarray(frames)
    people: defaultdict[int, dict[str, np.ndarray]] = defaultdict(dict)
    pose = np.concatenate((turns.flatten(1).numpy(), np.zeros((len(turns), 6), np.float32)), 1)
    people[0] = {
        "pose": pose[rows], "trans": (pelvis.numpy() - SMPL_PELVIS)[rows],
        "betas": np.zeros((len(rows), 10), np.float32), "frame_ids": rows,
    }  # fmt: skip
    path = folder / "wham_output.pkl"
    path.write_bytes(pickle.dumps(people))  # joblib's files are pickles, its arrays aside
    return path
