"""Comparisons of a clip with what came back from a layout."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose


def same_cameras(got: Sequence[Camera], want: Sequence[Camera], tolerance: float = 1e-6) -> None:
    """World-to-camera to `tolerance`, and intrinsics to `tolerance` of their size."""
    assert len(got) == len(want)
    for g, w in zip(got, want):
        assert (g.width, g.height) == (w.width, w.height)
        assert float((g.world_to_camera - w.world_to_camera).abs().max()) <= tolerance
        assert float(((g.K - w.K).abs() / w.K.abs().clamp(min=1)).max()) <= tolerance


def same_poses(
    got: BodyPose, want: BodyPose, tolerance: float = 1e-5, fingers: bool = True
) -> None:
    """Rotations as matrices (an axis-angle has several spellings), places in metres."""
    joints = 52 if fingers else 22
    turns = [axis_angle_to_matrices(p.rotations[..., :joints, :].double()) for p in (got, want)]
    assert float((turns[0] - turns[1]).abs().max()) <= tolerance
    assert float((got.transl - want.transl).abs().max()) <= tolerance
    width = min(got.betas.shape[-1], want.betas.shape[-1])
    assert torch.allclose(got.betas[..., :width], want.betas[..., :width], atol=1e-6)
    assert not got.betas[..., width:].any()
