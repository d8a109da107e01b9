"""BEHAVE's JSON files: a sequence's info, a Kinect's lens and its place."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from hoigs.core.errors import ClipError
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.common.poses import checked_rotation, rigid

ShortText = Annotated[str, Field(max_length=1000)]  # no path or word is longer


class SequenceInfo(BaseModel):
    """info.json; config and intrinsic are relative to the sequence."""

    config: ShortText
    intrinsic: ShortText
    cat: ShortText
    gender: ShortText | None = None


class ColorCalibration(BaseModel):
    """Of the colour camera. opencv: fx, fy, cx, cy in some order, then the distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    opencv: list[float]

    def lens(self) -> Lens:
        """OpenCV's calibration: pixel centres are at whole numbers."""
        K = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        return Lens.opencv(K, self.opencv[4:], self.width, self.height, pixel_center=0.0)


class Calibration(BaseModel):
    """intrinsics/K/calibration.json."""

    color: ColorCalibration


class KinectPose(BaseModel):
    """config/K/config.json: colour camera to the world, which is Kinect 1's colour camera."""

    rotation: list[float]
    translation: list[float]

    def world_to_camera(self, where: str) -> np.ndarray:
        if (len(self.rotation), len(self.translation)) != (9, 3):
            raise ClipError(f"{where}: expected 9 numbers of rotation and 3 of translation")
        turn = checked_rotation(np.reshape(self.rotation, (3, 3)), where)
        return rigid(turn.T, -turn.T @ np.array(self.translation))
