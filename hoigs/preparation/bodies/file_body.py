"""A body that another program has fitted, and what of it a clip takes."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from hoigs.core.values.lens import Lens
from hoigs.preparation.body.kinematics import nearest_turn
from hoigs.preparation.video.source import LANDMARKS, SourceError


@dataclass(frozen=True)
class FileBody:
    """One person, as a program has written them.

    Attributes:
        program: who wrote it. path: the file.
        frames: of the video that it has, rising.
        turns: axis-angle of SMPL's joints 0..21, the first in the camera's axes.
        pelvis: place in the camera (x right, y down, z away), metres.
        intrinsics: pixels of the video; None: those of `focal`, with the centre in the middle.
        people: that the file has; this one is in most frames.
        resized: the program made the video smaller, and `intrinsics` are of that.
        focal: in diagonals of the picture, or in its longer sides where `weak`.
        weak: the program knows no distance, and its focal length is a convention.
    """

    program: str
    path: Path
    frames: Int[np.ndarray, " N"]
    turns: Float[np.ndarray, "N 22 3"]
    pelvis: Float[np.ndarray, "N 3"]
    intrinsics: Float[np.ndarray, "N 3 3"] | None
    people: int = 1
    resized: bool = False
    focal: float = 1.0
    weak: bool = False

    def K(self, width: int, height: int) -> Float[np.ndarray, "N 3 3"]:
        """Intrinsics of each frame of a video of this size.

        Raises:
            SourceError: the file belongs to a video of another size.
        """
        if self.intrinsics is None:
            focal = self.focal * (max(width, height) if self.weak else math.hypot(width, height))
            one = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
            return np.broadcast_to(one, (len(self.frames), 3, 3))
        size = 2 * np.median(self.intrinsics[:, :2, 2], axis=0)
        if self.resized and abs(size[0] * height / (size[1] * width) - 1) < 0.02:
            return self.intrinsics * np.array([[width / size[0]], [height / size[1]], [1.0]])
        if np.abs(size / (width, height) - 1).max() > 0.02:
            raise SourceError(
                f"{self.path}: its intrinsics are of a video of {size[0]:.0f}x{size[1]:.0f} px, "
                f"this one has {width}x{height}; run {self.program} on this video"
            )
        return self.intrinsics

    def gives_landmarks(self, others: Collection[str], named: bool) -> bool:
        """Landmarks are taken from this body: no estimator of them is named in `others`, and there
        is no file of them beside it, unless this one is `named`."""
        beside = (self.path.parent / LANDMARKS).is_file()
        return "landmarks" not in others and (named or not beside)

    def lens(self, width: int, height: int) -> tuple[Lens, str] | None:
        """The middle of its intrinsics over the frames, and where they come from; None where they
        are a convention."""
        if self.weak:
            return None
        K = np.median(self.K(width, height), axis=0)
        params = tuple(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        return Lens("PINHOLE", params, width, height), f"{self.program}'s, in {self.path.name}"

    def used(self, numbers: Sequence[int]) -> str:
        """What became of it in a clip of these frames, for the report."""
        lacking = len(set(numbers) - set(self.frames.tolist()))
        lines = [f"started from {self.program}'s joint rotations in {self.path.name}"]
        if lacking:
            lines.append(f"interpolated in {lacking} of {len(numbers)} frames that it lacks")
        if self.people > 1:
            lines.append(f"of its {self.people} people the one in most frames")
        return ", ".join(lines) + "; its shape is not used"

    def rotations(self, numbers: Sequence[int]) -> Float[torch.Tensor, "F 21 3"]:
        """Axis-angle of joints 1..21 in these frames; those that it lacks are interpolated."""
        joints = torch.from_numpy(self.turns[:, 1:]).unbind(1)
        turns = torch.stack([nearest_turn(joint) for joint in joints], 1).numpy()
        columns = turns.reshape(len(turns), -1).T
        filled = np.stack([np.interp(numbers, self.frames, column) for column in columns], -1)
        return torch.from_numpy(filled).float().unflatten(-1, (21, 3))
