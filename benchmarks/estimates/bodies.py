"""The true body of a built-in clip in the files that GVHMR, WHAM and SAM 3D Body write."""

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
    """hmr4d_results.pt ("gvhmr"), wham_output.pkl ("wham") or sam_3d_body.pkl ("sam-3d-body"), as
    the program would have written it had it found the true pose, up to noise; the intrinsics of
    GVHMR and SAM 3D Body are the true ones.

    Args:
        degrees, cm: standard deviation of each joint's rotation and of the place, each frame; of
            SAM 3D Body's, which has keypoints, of each keypoint's place alone.
        frames: that WHAM's person is in; None: all.
    """
    import torch

    from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle

    rng = np.random.default_rng(seed)
    if program == "sam-3d-body":
        return _keypoints(clip, body, folder, rng, cm)
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


def _keypoints(clip: Any, body: Any, folder: Path, rng: np.random.Generator, cm: float) -> Path:
    """What SAM 3D Body's process_one_image returns for each frame. Eyes lie at the nose and thumbs
    at the knuckle of the index finger; keypoints that are not read lie at the hips."""
    import torch

    from hoigs.core.maths.skinning import skin
    from hoigs.preparation.body.body_files import MHR_LANDMARKS
    from hoigs.preparation.body.landmarks import points_of

    points = points_of(body)
    poses = clip.bodies["human"].poses
    vertices, joints = body.shaped(poses.betas)
    bound = torch.cat(
        (torch.eye(len(joints))[points.joints], body.skinning_weights[points.vertices])
    )
    rest = torch.cat((joints[points.joints], vertices[points.vertices]))
    world = skin(rest, body.skinning_transforms(poses), bound)
    frames = []
    for camera, places in zip(clip.cameras, world, strict=True):
        seen = camera.to_camera(places).numpy()
        hips = seen[[points.index(23), points.index(24)]].mean(0)
        keypoints = np.tile(hips, (70, 1))
        for number, landmark in MHR_LANDMARKS.items():
            near = {2: 0, 5: 0, 21: 19, 22: 20}.get(landmark, landmark)
            keypoints[number] = seen[points.index(near)]
        keypoints += rng.normal(size=keypoints.shape) * cm / 100
        pixels = keypoints @ camera.K.numpy().T
        frames.append([{
            "focal_length": np.float32(camera.K[0, 0]), "pred_cam_t": hips.astype(np.float32),
            "pred_keypoints_3d": (keypoints - hips).astype(np.float32),
            "pred_keypoints_2d": (pixels[:, :2] / pixels[:, 2:]).astype(np.float32),
        }])  # fmt: skip
    path = folder / "sam_3d_body.pkl"
    path.write_bytes(pickle.dumps(frames))
    return path
