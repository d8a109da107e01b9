"""What a video shows of one object, and of all that may hide or hold it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.preparation.mask_stack import Images, MaskStack


@dataclass(frozen=True)
class Filmed:
    """One object in all frames.

    Attributes:
        masks: its own. humans: of all people. others: of other objects, whose depth is unknown:
            they hide this one wherever they cover it.
        images: gives the undistorted frames anew on every call. fps: frames a second.
        joints: of the body at it, world, metres; None: nobody is there, and the object is at
            `depths` along the view. parents: of the joints.
    """

    masks: MaskStack
    humans: MaskStack
    others: MaskStack
    cameras: Sequence[Camera]
    images: Images
    fps: float
    joints: Float[Tensor, "F J 3"] | None
    parents: Sequence[int]
    depths: Float[np.ndarray, " F"] | None = None

    def hiding(self) -> MaskStack:
        """Pixels of people and other objects."""
        return MaskStack(h | o for h, o in zip(self.humans, self.others, strict=True))
