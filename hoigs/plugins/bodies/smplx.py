"""body:smplx: SMPL-X from the user's own model file; the file itself is never shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.errors import HoigsError
from hoigs.plugins.bodies.corrected import CorrectedBody, own_template
from hoigs.plugins.bodies.model_files import Layout, read_model, require_gender

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
_WHERE = (
    "SMPL-X model files (SMPLX_NEUTRAL.npz, SMPLX_MALE.npz, SMPLX_FEMALE.npz) are a registered "
    "download at https://smpl-x.is.tue.mpg.de; or use body:anny, which needs no download"
)


class SmplxConfig(ComponentConfig):
    """Settings of `body:smplx`."""

    path: Path = Field(description="your SMPLX_NEUTRAL.npz, SMPLX_MALE.npz or SMPLX_FEMALE.npz")
    num_betas: int = Field(default=10, ge=1, le=300, description="shape coefficients in use")
    template: Path | None = Field(
        default=None,
        description="the person's own zero-pose mesh (ARCTIC's subject_vtemplates); by default the "
        "clip's, else the model's mean",
    )


class SmplxBody(CorrectedBody):
    """SMPL-X (Pavlakos 2019): 55 joints, shape and pose blendshapes, no expression.

    Args:
        path: an `SMPLX_*.npz`; read with numpy only, without unpickling.
        num_betas: shape coefficients in use, the first of the file's.
        template: a person's own vertices in the zero pose, metres, in place of the file's mean.

    Attributes:
        hand_means: [2, 15, 3], the mean pose of left and right hand, axis-angle. A BodyPose with
            hand_pose_convention="mean" (flat_hand_mean=False elsewhere) has it added.

    Raises:
        HoigsError: the file is absent, is not SMPL-X, or has fewer shape directions; or it is of
            another gender than the clip's poses (when built from a spec).
    """

    def __init__(
        self,
        path: str | Path,
        num_betas: int = 10,
        template: Float[Tensor, "V 3"] | None = None,
    ) -> None:
        file = read_model("body:smplx", Path(path), _LAYOUT, _WHERE)
        width = file["shapedirs"].shape[2]
        # 300 shape + 100 expression directions, or 10 + 10 in older files
        available = 300 if width >= 400 else min(width, 10)
        if num_betas > available:
            raise HoigsError(
                f"{path} has {available} shape directions, num_betas asks for {num_betas}"
            )
        parents = file["kintree_table"][0].astype(np.int64)
        parents[0] = -1  # the file says 2^32 - 1
        directions = torch.from_numpy(file["posedirs"].astype(np.float64))
        super().__init__(
            file,
            num_betas=num_betas,
            template=template,
            pose_directions=directions,
            joint_names=JOINT_NAMES,
            parents=parents.tolist(),
        )

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        require_gender("body:smplx", config.path, context.body_track)
        template = own_template(config.template, context.body_track)
        return cls(config.path, config.num_betas, template)
