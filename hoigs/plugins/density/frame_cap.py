"""How many Gaussians a scene's frames can tell apart."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from hoigs.core.context import BuildContext

PER_PIXEL = 0.57  # Gaussians a pixel: what real clips of 0.18 to 0.23 megapixels still gain from
LEAST, MOST = 10_000, 1_000_000


# what a spec may say: a number, "auto", "auto/2" for half as many, or "auto+14000" for a scene that
# shows other things too
AUTO = r"^auto(/[1-9]\d*)?(\+\d+)?$"
Cap = Annotated[int, Field(ge=1)] | Annotated[str, Field(pattern=AUTO)]


def cap_in(context: BuildContext, cap: int | str) -> int:
    """`cap`; of "auto", 0.57 Gaussians for each pixel of one frame, within 10,000 and 1,000,000;
    of "auto/D", the D-th part; of "auto+N", N more.

    Raises:
        ValueError: "auto" where there is no clip to count pixels of.
    """
    if isinstance(cap, int):
        return cap
    if context.clip is None:
        raise ValueError('cap "auto" counts the pixels of a clip, and none is given: say a number')
    camera = context.clip.cameras[0]
    base = min(max(int(PER_PIXEL * camera.width * camera.height), LEAST), MOST)
    part, _, more = cap.partition("+")
    return base // int(part.partition("/")[2] or 1) + int(more or 0)
