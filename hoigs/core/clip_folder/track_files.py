"""The npz files of a clip folder's bodies and objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hoigs.core.clip_folder.frame_files import as_array
from hoigs.core.errors import ClipError
from hoigs.core.values.clip import BodyTrack, ObjectTrack


def save_body(path: Path, track: BodyTrack) -> None:
    """Write a body's poses and shape.

    Raises:
        ClipError: the shape is not the same for all frames.
    """
    path.parent.mkdir(exist_ok=True)
    poses = track.poses
    if poses.betas.dim() != 1:
        raise ClipError(f"betas have shape {list(poses.betas.shape)}; a clip shares one [B]")
    # numpy declares these keywords as its own options
    special: dict[str, Any] = {}
    if track.gender is not None:
        special["gender"] = np.array(track.gender)
    if track.template is not None:
        special["template"] = as_array(track.template)
    np.savez_compressed(
        path,
        **special,
        global_orient=as_array(poses.global_orient),
        body=as_array(poses.body),
        left_hand=as_array(poses.left_hand),
        right_hand=as_array(poses.right_hand),
        transl=as_array(poses.transl),
        betas=as_array(poses.betas),
        hand_pose_convention=np.array(poses.hand_pose_convention),
        model=np.array(track.model),
        provenance=np.array(track.provenance),
    )


def save_object(path: Path, track: ObjectTrack) -> None:
    """Write an object's points and poses."""
    path.parent.mkdir(exist_ok=True)
    # numpy declares these keywords as its own options
    parts: dict[str, Any] = {}
    if track.moving is not None:
        parts["moving"] = as_array(track.moving, np.bool_)
    if not track.rotation_known:
        parts["rotation_known"] = np.array(False)
    np.savez_compressed(
        path,
        **parts,
        points=as_array(track.points),
        colors=as_array(track.colors),
        rotations=as_array(track.rotations),
        translations=as_array(track.translations),
        observed=as_array(track.observed, np.bool_),
        provenance=np.array(track.provenance),
    )
