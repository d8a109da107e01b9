"""How far joints bend: soft limits on axis-angle components, from the T-pose, y up, facing +z."""

from __future__ import annotations

import functools
import math

import torch
from jaxtyping import Float
from torch import Tensor

# body joint (1..21) -> limits of the x, y, z components, degrees. Knees bend about +x, the left
# elbow about -y and the right one about +y; generous values of ordinary anatomy. A forearm that
# twists while the elbow is bent has a z component there, and a y component at the wrist.
LIMITS: dict[int, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    1: ((-120, 50), (-50, 50), (-30, 60)),
    2: ((-120, 50), (-50, 50), (-60, 30)),
    3: ((-25, 40), (-25, 25), (-20, 20)),
    4: ((-2, 150), (-10, 10), (-8, 8)),
    5: ((-2, 150), (-10, 10), (-8, 8)),
    6: ((-20, 30), (-25, 25), (-20, 20)),
    7: ((-40, 50), (-25, 25), (-20, 20)),
    8: ((-40, 50), (-25, 25), (-20, 20)),
    9: ((-15, 25), (-20, 20), (-15, 15)),
    10: ((-10, 30), (-3, 3), (-3, 3)),
    11: ((-10, 30), (-3, 3), (-3, 3)),
    12: ((-35, 40), (-45, 45), (-25, 25)),
    13: ((-10, 10), (-25, 15), (-15, 30)),
    14: ((-10, 10), (-15, 25), (-30, 15)),
    15: ((-30, 30), (-40, 40), (-20, 20)),
    16: ((-90, 90), (-130, 60), (-110, 100)),
    17: ((-90, 90), (-60, 130), (-100, 110)),
    18: ((-80, 80), (-150, 2), (-30, 30)),
    19: ((-80, 80), (-2, 150), (-30, 30)),
    20: ((-40, 40), (-45, 45), (-70, 70)),
    21: ((-40, 40), (-45, 45), (-70, 70)),
}


@functools.cache
def _bounds() -> tuple[Float[Tensor, "21 3"], Float[Tensor, "21 3"]]:
    """Lowest and highest angles, radians."""
    degrees = torch.tensor([LIMITS[joint] for joint in range(1, 22)])
    radians = degrees * (math.pi / 180)
    return radians[..., 0], radians[..., 1]


def beyond(body: Float[Tensor, "*batch 21 3"]) -> Float[Tensor, "*batch 21 3"]:
    """Radians by which angles exceed their limits, negative below the lowest; 0 within."""
    low, high = (bound.to(body) for bound in _bounds())
    return (body - high).clamp_min(0) - (low - body).clamp_min(0)
