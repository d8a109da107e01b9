"""body:smplh and body:smpl: SMPL+H and SMPL from the user's own model files, never shipped.

Both take the first 22 joints of SMPL-X with the same tree and axes, so a BodyPose is theirs as it
stands; shapes and `transl` are their own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.body_params import KNUCKLES
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.errors import HoigsError
from hoigs.plugins.bodies.corrected import CorrectedBody, own_template
from hoigs.plugins.bodies.model_files import Layout, read_model, require_gender
from hoigs.plugins.bodies.smplx import JOINT_NAMES as SMPLX_JOINTS

JOINT_NAMES = (*SMPLX_JOINTS[:22], *SMPLX_JOINTS[25:])
BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
PARENTS = (
    *BODY_PARENTS,
    *(p for wrist, start in ((20, 22), (21, 37)) for f in range(5)
      for p in (wrist, start + 3 * f, start + 3 * f + 1)),
)  # fmt: skip
# SMPL turns each hand at one joint; in a BodyPose that is where all knuckles turn alike
LEFT_BLOCK, RIGHT_BLOCK = 22 + KNUCKLES[1], 37 + KNUCKLES[1]


def _layout(joints: int) -> Layout:
    return {
        "v_template": ("V", 3),
        "f": ("F", 3),
        "weights": ("V", joints),
        "J_regressor": (joints, "V"),
        "posedirs": ("V", 3, 9 * (joints - 1)),
        "shapedirs": ("V", 3, "S"),
        "kintree_table": (2, joints),
    }


_SMPLH_WHERE = (
    "SMPL+H model files as .npz (male/model.npz, female/model.npz, neutral/model.npz) are a "
    'registered download at https://mano.is.tue.mpg.de ("Extended SMPL+H model"); pickled ones '
    "are not opened"
)
_SMPL_WHERE = (
    "SMPL model files (SMPL_NEUTRAL, SMPL_MALE, SMPL_FEMALE) are a registered download at "
    "https://smpl.is.tue.mpg.de; it is a pickle, so save its arrays once with numpy.savez, as "
    "v_template, f, weights, J_regressor (dense), posedirs, shapedirs, kintree_table"
)


class SmplhConfig(ComponentConfig):
    """Settings of `body:smplh`."""

    path: Path = Field(description="your SMPL+H model.npz, of the gender that the poses are for")
    num_betas: int = Field(default=10, ge=1, le=300, description="shape coefficients in use")
    template: Path | None = Field(default=None, description="the person's own zero-pose mesh")


class SmplConfig(ComponentConfig):
    """Settings of `body:smpl`."""

    path: Path = Field(description="your SMPL model as .npz")
    num_betas: int = Field(default=10, ge=1, le=300, description="shape coefficients in use")
    template: Path | None = Field(default=None, description="the person's own zero-pose mesh")


class SmplhBody(CorrectedBody):
    """SMPL+H (Romero 2017): 52 joints, those of a BodyPose; what BEHAVE is fitted with.

    Args:
        path: an .npz; read without unpickling. num_betas: the first of the file's.
        template: a person's own zero-pose vertices, metres, in place of the file's mean.

    Raises:
        HoigsError: the file is absent, is not SMPL+H, or has fewer shape directions.
    """

    def __init__(
        self,
        path: str | Path,
        num_betas: int = 10,
        template: Float[Tensor, "V 3"] | None = None,
    ) -> None:
        file = read_model("body:smplh", Path(path), _layout(52), _SMPLH_WHERE)
        _require_betas(path, file, num_betas)
        super().__init__(
            file,
            num_betas=num_betas,
            template=template,
            pose_directions=torch.from_numpy(file["posedirs"].astype(np.float64)),
            joint_names=JOINT_NAMES,
            parents=PARENTS,
        )

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        require_gender("body:smplh", config.path, context.body_track)
        template = own_template(config.template, context.body_track)
        return cls(config.path, config.num_betas, template)


class SmplBody(CorrectedBody):
    """SMPL (Loper 2015) behind a BodyPose: 52 joints, of which a hand's block turns at one.

    Its two hand joints stand at the middle knuckle, where all fingers of a hand are bound; the
    other 28 finger joints move nothing. A pose from `pose_from_smpl` is exact; one whose fingers
    bend one by one is not SMPL's, and is refused.

    Args:
        path: an .npz; read without unpickling. num_betas: the first of the file's.
        template: a person's own zero-pose vertices, metres, in place of the file's mean.

    Raises:
        HoigsError: the file is absent, is not SMPL, or has fewer shape directions.
    """

    def __init__(
        self,
        path: str | Path,
        num_betas: int = 10,
        template: Float[Tensor, "V 3"] | None = None,
    ) -> None:
        file = read_model("body:smpl", Path(path), _layout(24), _SMPL_WHERE)
        _require_betas(path, file, num_betas)
        # a finger joint stands where its hand's joint stands; only the middle knuckle has weights
        source = np.array([*range(22), *[22] * 15, *[23] * 15])
        bound = [*range(22), LEFT_BLOCK, RIGHT_BLOCK]
        weights = np.zeros((len(file["weights"]), 52))
        weights[:, bound] = file["weights"]
        directions = np.zeros((len(weights), 3, 51, 9))
        turned = [j - 1 for j in bound[1:]]
        directions[:, :, turned] = file["posedirs"].reshape(len(weights), 3, 23, 9)
        file = {**file, "weights": weights, "J_regressor": file["J_regressor"][source]}
        super().__init__(
            file,
            num_betas=num_betas,
            template=template,
            pose_directions=torch.from_numpy(directions.reshape(len(weights), 3, -1)),
            joint_names=JOINT_NAMES,
            parents=PARENTS,
        )

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        require_gender("body:smpl", config.path, context.body_track)
        template = own_template(config.template, context.body_track)
        return cls(config.path, config.num_betas, template)


def _require_betas(path: str | Path, file: dict[str, np.ndarray], num_betas: int) -> None:
    available = file["shapedirs"].shape[2]
    if num_betas > available:
        raise HoigsError(f"{path} has {available} shape directions, num_betas asks for {num_betas}")
