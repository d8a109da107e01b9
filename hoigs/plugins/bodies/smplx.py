"""body:smplx: SMPL-X from the user's own model file; the file itself is not part of hoigs."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from hoigs.plugins.bodies.corrected import CorrectedBody, ModelFileConfig
from hoigs.plugins.bodies.model_files import Layout

_FINGERS = [f"{f}{i}" for f in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)]
JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar",
    "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist", "jaw", "left_eye", "right_eye",
    *(f"left_{f}" for f in _FINGERS), *(f"right_{f}" for f in _FINGERS),
)  # fmt: skip

# key -> shape; V vertices, F triangles, S shape and expression directions
_LAYOUT: Layout = {
    "v_template": ("V", 3),
    "f": ("F", 3),
    "weights": ("V", 55),
    "J_regressor": (55, "V"),
    "posedirs": ("V", 3, 486),
    "shapedirs": ("V", 3, "S"),
    "kintree_table": (2, 55),
    "hands_meanl": (45,),
    "hands_meanr": (45,),
}
_SOURCE = (
    "SMPL-X model files (SMPLX_NEUTRAL.npz, SMPLX_MALE.npz, SMPLX_FEMALE.npz) are a registered "
    "download at https://smpl-x.is.tue.mpg.de; or use body:anny, which needs no download"
)


class SmplxConfig(ModelFileConfig):
    """Settings of `body:smplx`; `path` is an SMPLX_NEUTRAL.npz, SMPLX_MALE.npz or
    SMPLX_FEMALE.npz."""


class SmplxBody(CorrectedBody):
    """SMPL-X (Pavlakos et al. 2019, arXiv:1904.05866): 55 joints, shape and pose blendshapes, no
    expression. For arguments and errors see CorrectedBody."""

    Config: ClassVar = SmplxConfig
    key = "body:smplx"
    layout = _LAYOUT
    source = _SOURCE
    names = JOINT_NAMES

    def shape_directions_of(self, file: dict[str, np.ndarray]) -> int:
        width = file["shapedirs"].shape[2]
        # 300 shape + 100 expression directions, or 10 + 10 in older files
        return 300 if width >= 400 else min(width, 10)
