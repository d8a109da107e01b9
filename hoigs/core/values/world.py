"""World: which way is up in a clip's world, where its floor is, and how that is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.camera import Camera

How = Literal["given", "floor", "lines", "body", "cameras (guess)"]
GUESS: How = "cameras (guess)"


@dataclass(frozen=True)
class World:
    """The world of a clip, in its own axes.

    Attributes:
        up: unit vector against gravity.
        floor: height of the floor along `up` (a point p lies on it where p . up == floor); None
            where it is not known.
        metres: whether lengths are metres; False where their unit is arbitrary.
        known: who says so. "given": the data. "floor": feet that stood in several places.
            "lines": vertical lines of the room. "body": the people, while they stand upright.
            "cameras (guess)": the mean upward direction of the cameras, which is wrong by as much
            as they are tilted.
        within: degrees within which `up` is, in nine of ten cases; None where that is not known.

    Raises:
        ValueError: `up` has no direction, `floor` is not finite, `known` is another word, or
            `within` is no angle.
    """

    up: tuple[float, float, float]
    floor: float | None = None
    metres: bool = True
    known: How = "given"
    within: float | None = None

    def __post_init__(self) -> None:
        length = math.hypot(*self.up)
        if not (len(self.up) == 3 and math.isfinite(length) and length > 1e-9):
            raise ValueError(f"up is {self.up}, expected three finite numbers, not all zero")
        if self.floor is not None and not math.isfinite(self.floor):
            raise ValueError(f"floor is {self.floor}, expected a finite number or None")
        if self.known not in get_args(How):
            raise ValueError(f"known is {self.known!r}, expected one of {', '.join(get_args(How))}")
        if self.within is not None and not 0 <= self.within <= 180:
            raise ValueError(f"within is {self.within}, expected 0 to 180 degrees or None")
        if abs(length - 1) < 1e-12:  # so that what is stored comes back as it was
            length = 1.0
        x, y, z = (float(value) / length for value in self.up)
        object.__setattr__(self, "up", (x, y, z))

    @classmethod
    def guessed(cls, cameras: Sequence[Camera], *, metres: bool = True) -> World:
        """Up as the cameras have it on average, and no floor: a COLMAP world defines neither."""
        if not cameras:  # as a camera at the origin has it
            return cls((0.0, -1.0, 0.0), metres=metres, known=GUESS)
        ups = torch.stack([-camera.world_to_camera[1, :3].double().cpu() for camera in cameras])
        up = ups.mean(0)
        if not float(up.norm()) > 1e-6:  # a camera that rolled over fully
            up = ups[0]
        return cls((float(up[0]), float(up[1]), float(up[2])), metres=metres, known=GUESS)

    @property
    def is_guess(self) -> bool:
        return self.known == GUESS

    def up_vector(self) -> Float[Tensor, " 3"]:
        """`up` as a float32 tensor on the CPU."""
        return torch.tensor(self.up)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"up": list(self.up)}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> World:
        """The inverse of `to_dict`; ValueError as the class."""
        x, y, z = content["up"]
        within = content.get("within")  # of folders that were written before 0.3: not known
        return cls((x, y, z), content["floor"], content["metres"], content["known"], within)
