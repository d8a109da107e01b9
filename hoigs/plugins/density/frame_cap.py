"""The cap "auto": as many Gaussians as the frames of a clip can resolve."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from hoigs.core.values.clip import Clip

PER_PIXEL = 0.57  # Gaussians a pixel: up to here, real clips of 0.18 to 0.23 megapixels improve
LEAST, MOST = 10_000, 1_000_000

# a number, "auto", "auto/2" for half as many, or "auto+14000" for an entity that shows more
AUTO = r"^auto(/[1-9]\d*)?(\+\d+)?$"
Cap = Annotated[int, Field(ge=1)] | Annotated[str, Field(pattern=AUTO)]


def resolve_cap(cap: int | str, clip: Clip | None) -> int:
    """`cap` as a number.

    "auto" is 0.57 Gaussians for each pixel of a frame, from 10,000 to 1,000,000; "auto/D" is the
    D-th part of that, and "auto+N" is N more.

    Raises:
        ValueError: "auto" without a clip.
    """
    if isinstance(cap, int):
        return cap
    if clip is None:
        raise ValueError(
            f'cap "{cap}" depends on the frame size of a clip, and no clip is given; set a number'
        )
    camera = clip.cameras[0]
    base = min(max(int(PER_PIXEL * camera.width * camera.height), LEAST), MOST)
    part, _, more = cap.partition("+")
    return base // int(part.partition("/")[2] or 1) + int(more or 0)
