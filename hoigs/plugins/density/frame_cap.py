"""How many Gaussians a scene's frames can tell apart."""

from __future__ import annotations

from typing import Literal

from hoigs.core.context import BuildContext

PER_PIXEL = 0.4  # Gaussians a pixel: what real clips of 0.18 to 0.23 megapixels still gain from
LEAST, MOST = 10_000, 1_000_000


def cap_in(context: BuildContext, cap: int | Literal["auto"]) -> int:
    """`cap`; of "auto", 0.4 Gaussians for each pixel of one frame, within 10,000 and 1,000,000.

    Raises:
        ValueError: "auto" where there is no clip to count pixels of.
    """
    if cap != "auto":
        return cap
    if context.clip is None:
        raise ValueError('cap "auto" counts the pixels of a clip, and none is given: say a number')
    camera = context.clip.cameras[0]
    return min(max(int(PER_PIXEL * camera.width * camera.height), LEAST), MOST)
