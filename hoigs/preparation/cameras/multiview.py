"""How much of several views a single moving camera gives: DyCheck's effective multi-view factors.

Gao et al. 2022, "Monocular Dynamic View Synthesis: A Reality Check" (arXiv 2210.13445), Sec. 3.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.camera import Camera

STILL = 1e-4  # metres a frame: what moves less stands still


def angular_factor(cameras: Sequence[Camera], target: Float[Tensor, "F 3"], fps: float) -> float:
    """omega: how fast the camera goes round what moves, degrees a second; 0 for a static camera.

    The mean over frames of the angle between two successive views, times the frame rate. DyCheck
    takes the point that all optical axes pass; here it is `target`, the person in each frame.
    """
    if len(cameras) < 2:
        return 0.0
    centers = torch.stack([c.center for c in cameras]).double()
    middle = 0.5 * (target[1:] + target[:-1]).double()
    before, after = centers[:-1] - middle, centers[1:] - middle
    # atan2, because the cosine of a small angle has lost it
    angle = torch.atan2(torch.linalg.cross(before, after).norm(dim=-1), (before * after).sum(-1))
    return float(torch.rad2deg(angle.mean()) * fps)


def full_factor(cameras: Sequence[Camera], points: Float[Tensor, "F P 3"]) -> float | None:
    """Omega: how much faster the camera moves than what it looks at; None if nothing moves.

    |o_t+1 - o_t| over |x_t+1 - x_t|, the mean over points that move, the median over
    frames (DyCheck takes the mean, which moments of rest make infinite).
    """
    if len(cameras) < 2:
        return None
    centers = torch.stack([c.center for c in cameras])
    camera = (centers[1:] - centers[:-1]).norm(dim=-1)
    scene = (points[1:] - points[:-1]).norm(dim=-1).mean(-1)
    moving = scene > STILL
    return float((camera[moving] / scene[moving]).median()) if moving.any() else None
