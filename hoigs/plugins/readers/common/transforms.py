"""transforms.json, the camera file of Blender scenes (NeRF, D-NeRF) and nerfstudio."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, FiniteFloat, field_validator

from hoigs.core.errors import ClipError
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.common.lazy_frames import image_size, lens_for

# nerfstudio's camera models -> whether the lens is a fisheye
PERSPECTIVE = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV",
               "FULL_OPENCV")  # fmt: skip
FISHEYE = ("FISHEYE", "OPENCV_FISHEYE")


class Intrinsics(BaseModel):
    """Keys at the top of the file or in a frame; those of the frame take precedence."""

    camera_model: str | None = None
    camera_angle_x: FiniteFloat | None = None
    fl_x: FiniteFloat | None = None
    fl_y: FiniteFloat | None = None
    cx: FiniteFloat | None = None
    cy: FiniteFloat | None = None
    w: FiniteFloat | None = None
    h: FiniteFloat | None = None
    k1: FiniteFloat | None = None
    k2: FiniteFloat | None = None
    k3: FiniteFloat | None = None
    k4: FiniteFloat | None = None
    p1: FiniteFloat | None = None
    p2: FiniteFloat | None = None


def _slashes(path: str) -> str:
    return path.replace("\\", "/")


# a path of the file, which Windows writes with backslashes
DataPath = Annotated[str, AfterValidator(_slashes)]


class TransformFrame(Intrinsics):
    """One image."""

    file_path: DataPath
    transform_matrix: list[list[FiniteFloat]]
    time: FiniteFloat | None = None
    mask_path: DataPath | None = None
    depth_file_path: DataPath | None = None

    @field_validator("transform_matrix")
    @classmethod
    def _is_4x4(cls, rows: list[list[float]]) -> list[list[float]]:
        if [len(row) for row in rows] not in ([4] * 4, [4] * 3):
            raise ValueError("expected 4 rows of 4 numbers")
        return rows

    @property
    def camera_to_world(self) -> np.ndarray:
        return np.array([*self.transform_matrix[:3], [0, 0, 0, 1]], np.float64)


class Transforms(Intrinsics):
    """The file."""

    frames: list[TransformFrame]
    applied_transform: list[list[FiniteFloat]] | None = None
    applied_scale: FiniteFloat = 1.0
    ply_file_path: DataPath | None = None
    train_filenames: list[DataPath] | None = None
    val_filenames: list[DataPath] | None = None
    test_filenames: list[DataPath] | None = None


def lens_of(file: Transforms, frame: TransformFrame, image: Path, where: str) -> Lens:
    """The lens of a frame at the size that its image has.

    The centre of the top-left pixel is at (0.5, 0.5) in these files: COLMAP's and Blender's rule.

    Args:
        where: names the frame in errors.

    Raises:
        ClipError: no focal length, or a lens model that cannot be undistorted.
    """

    def get(key: str) -> float:
        own = getattr(frame, key)
        value = own if own is not None else getattr(file, key)
        return 0.0 if value is None else float(value)

    width, height = image_size(image)
    w, h = int(get("w")) or width, int(get("h")) or height
    fx = get("fl_x")
    if fx == 0 and get("camera_angle_x") > 0:
        fx = 0.5 * w / math.tan(0.5 * get("camera_angle_x"))
    if fx <= 0:
        raise ClipError(f"{where}: no focal length; expected fl_x (pixels) or camera_angle_x (rad)")
    fy = get("fl_y") or fx
    # a principal point of 0 counts as absent; the default is the centre of the image
    center = [get("cx") or w / 2, get("cy") or h / 2]
    k1, k2, k3, k4, p1, p2 = (get(k) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = frame.camera_model or file.camera_model or "PERSPECTIVE"
    if model in FISHEYE:
        params = (fx, fy, *center, k1, k2, k3, k4)
        return lens_for(Lens("OPENCV_FISHEYE", params, w, h), image)
    if model not in PERSPECTIVE:
        raise ClipError(
            f"{where}: camera_model {model} has no pinhole image; this reads "
            f"{', '.join((*PERSPECTIVE, *FISHEYE))}"
        )
    if k4 != 0:
        raise ClipError(f"{where}: k4 = {k4:g} on a {model} lens: only fisheyes have a k4 here")
    K = np.array([[fx, 0, center[0]], [0, fy, center[1]], [0, 0, 1]])
    return lens_for(Lens.opencv(K, (k1, k2, p1, p2, k3), w, h), image)
