"""body:smplx, body:smplh and body:smpl, from the user's own model files, not part of hoigs."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from hoigs.core.model.smpl_params import KNUCKLES
from hoigs.plugins.bodies.corrected import HANDS, CorrectedBody, Layout, ModelFileConfig

_FINGERS = [f"{f}{i}" for f in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)]
SMPLX_JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar",
    "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist", "jaw", "left_eye", "right_eye",
    *(f"left_{f}" for f in _FINGERS), *(f"right_{f}" for f in _FINGERS),
)  # fmt: skip


def _layout(joints: int) -> Layout:
    """Shapes by key; V vertices, F triangles, S shape and expression directions."""
    return {
        "v_template": ("V", 3),
        "f": ("F", 3),
        "weights": ("V", joints),
        "J_regressor": (joints, "V"),
        "posedirs": ("V", 3, 9 * (joints - 1)),
        "shapedirs": ("V", 3, "S"),
        "kintree_table": (2, joints),
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
    layout: ClassVar = {**_layout(55), **dict.fromkeys(HANDS, (45,))}
    source = _SOURCE
    names = SMPLX_JOINT_NAMES

    def shape_directions_of(self, file: dict[str, np.ndarray]) -> int:
        width = file["shapedirs"].shape[2]
        # 300 shape + 100 expression directions, or 10 + 10 in older files
        return 300 if width >= 400 else min(width, 10)


# body:smplh and body:smpl: SMPL+H and SMPL from the user's own model files, not part of hoigs.
#
# Both use the first 22 joints of SMPL-X with the same tree and axes, so a BodyPose applies to them
# unchanged; shapes and `transl` are their own.

SMPLH_JOINT_NAMES = (*SMPLX_JOINT_NAMES[:22], *SMPLX_JOINT_NAMES[25:])
BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
PARENTS = (
    *BODY_PARENTS,
    *(p for wrist, start in ((20, 22), (21, 37)) for f in range(5)
      for p in (wrist, start + 3 * f, start + 3 * f + 1)),
)  # fmt: skip
# SMPL turns each hand at one joint, here the middle knuckle of a BodyPose
LEFT_BLOCK, RIGHT_BLOCK = 22 + KNUCKLES[1], 37 + KNUCKLES[1]


_SMPLH_SOURCE = (
    "SMPL+H model files as .npz (male/model.npz, female/model.npz, neutral/model.npz) are a "
    'registered download at https://mano.is.tue.mpg.de ("Extended SMPL+H model"); pickled ones '
    "are not opened"
)
_SMPL_SOURCE = (
    "SMPL model files (SMPL_NEUTRAL, SMPL_MALE, SMPL_FEMALE) are a registered download at "
    "https://smpl.is.tue.mpg.de; it is a pickle, so save its arrays once with numpy.savez, as "
    "v_template, f, weights, J_regressor (dense), posedirs, shapedirs, kintree_table"
)


class SmplhConfig(ModelFileConfig):
    """Settings of `body:smplh`; `path` is an SMPL+H model.npz."""


class SmplConfig(ModelFileConfig):
    """Settings of `body:smpl`; `path` is an SMPL model as .npz."""


class SmplhBody(CorrectedBody):
    """SMPL+H (Romero et al. 2017): the 52 joints of a BodyPose; BEHAVE is fitted with it.

    For arguments and errors see CorrectedBody.
    """

    Config: ClassVar = SmplhConfig
    key = "body:smplh"
    layout = _layout(52)
    source = _SMPLH_SOURCE
    names = SMPLH_JOINT_NAMES

    def adapted(self, file: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**file, "kintree_table": np.array([PARENTS])}


class SmplBody(CorrectedBody):
    """SMPL (Loper et al. 2015) with the 52 joints of a BodyPose, of which one turns a whole hand.

    Each of its two hand joints is at the middle knuckle, to which all fingers of a hand are bound;
    the other 28 finger joints move nothing. A pose from `pose_from_smpl` is exact; a pose whose
    fingers bend one by one is not an SMPL pose and is refused. For arguments and errors see
    CorrectedBody.
    """

    Config: ClassVar = SmplConfig
    key = "body:smpl"
    layout = _layout(24)
    source = _SMPL_SOURCE
    names = SMPLH_JOINT_NAMES

    def adapted(self, file: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        # each finger joint is placed at its hand's joint; only the middle knuckle has weights
        joints = np.array([*range(22), *[22] * 15, *[23] * 15])
        bound = [*range(22), LEFT_BLOCK, RIGHT_BLOCK]
        weights = np.zeros((len(file["weights"]), 52))
        weights[:, bound] = file["weights"]
        directions = np.zeros((len(weights), 3, 51, 9))
        turned = [j - 1 for j in bound[1:]]
        directions[:, :, turned] = file["posedirs"].reshape(len(weights), 3, 23, 9)
        return {
            **file,
            "weights": weights,
            "J_regressor": file["J_regressor"][joints],
            "posedirs": directions.reshape(len(weights), 3, -1),
            "kintree_table": np.array([PARENTS]),
        }
