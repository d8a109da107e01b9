"""body:smplx: SMPL-X from the user's own model file; the file itself is never shipped."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.moment import BodyPose
from hoigs.core.rotation import axis_angle_to_matrices
from hoigs.plugins.bodies.linear import LinearBody

_FINGERS = [f"{f}{i}" for f in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)]
JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar",
    "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist", "jaw", "left_eye", "right_eye",
    *(f"left_{f}" for f in _FINGERS), *(f"right_{f}" for f in _FINGERS),
)  # fmt: skip

# key -> shape; V vertices, F triangles, S shape and expression directions
_LAYOUT = {
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


class SmplxBody(LinearBody):
    """SMPL-X (Pavlakos 2019): 55 joints, shape and pose blendshapes, no expression.

    Args:
        path: an `SMPLX_*.npz`; read with numpy only, without unpickling.
        num_betas: shape coefficients in use, the first of the file's.

    Attributes:
        hand_means: [2, 15, 3], the mean pose of left and right hand, axis-angle. A BodyPose with
            hand_pose_convention="mean" (flat_hand_mean=False elsewhere) has it added.

    Raises:
        HoigsError: the file is absent, is not SMPL-X, or has fewer shape directions.
    """

    pose_directions: Float[Tensor, "486 D"]
    hand_means: Float[Tensor, "2 15 3"]

    def __init__(self, path: str | Path, num_betas: int = 10) -> None:
        file = _read(Path(path))
        width = file["shapedirs"].shape[2]
        # 300 shape + 100 expression directions, or 10 + 10 in older files
        available = 300 if width >= 400 else min(width, 10)
        if num_betas > available:
            raise HoigsError(
                f"{path} has {available} shape directions, num_betas asks for {num_betas}"
            )
        template = _tensor(file["v_template"])
        directions = _tensor(file["shapedirs"][:, :, :num_betas]).permute(2, 0, 1)
        regressor = _tensor(file["J_regressor"])
        parents = file["kintree_table"][0].astype(np.int64)
        parents[0] = -1  # the file says 2^32 - 1
        super().__init__(
            template=template.float(),
            shape_directions=directions.float().contiguous(),
            joints=(regressor @ template).float(),
            joint_shape_directions=(regressor @ directions).float(),
            weights=_tensor(file["weights"]).float(),
            faces=torch.from_numpy(file["f"].astype(np.int64)),
            joint_names=JOINT_NAMES,
            parents=parents.tolist(),
        )
        pose_directions = _tensor(file["posedirs"]).float().flatten(0, 1).T.contiguous()
        means = np.stack((file["hands_meanl"], file["hands_meanr"]))
        self.register_buffer("pose_directions", pose_directions, persistent=False)
        self.register_buffer(
            "hand_means", _tensor(means).float().unflatten(1, (15, 3)), persistent=False
        )

    def flat_hands(self, pose: BodyPose) -> BodyPose:
        """The same pose in the "flat" hand convention: the mean hand is added where it is due."""
        if pose.hand_pose_convention == "flat":
            return pose
        left, right = self.hand_means.to(pose.left_hand)
        return pose.replace(
            left_hand=pose.left_hand + left,
            right_hand=pose.right_hand + right,
            hand_pose_convention="flat",
        )

    def _pose_corrected(self, vertices: Tensor, rotations: Tensor) -> Tensor:
        """v + (R - I) of joints 1..54 along the pose directions (SMPL-X, eq. 4)."""
        matrices = axis_angle_to_matrices(rotations[..., 1:, :])
        feature = (matrices - torch.eye(3).to(matrices)).flatten(-3)
        offset = feature @ self.pose_directions.to(feature)
        return vertices + offset.unflatten(-1, (-1, 3))


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float64))


def _read(path: Path) -> dict[str, np.ndarray]:
    """The arrays that are needed, with their shapes checked."""
    if not path.is_file():
        raise HoigsError(f"body:smplx: there is no file {path}; {_WHERE}")
    try:
        opened = np.load(path, allow_pickle=False)
        if not isinstance(opened, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with opened as file:
            missing = [key for key in _LAYOUT if key not in file.files]
            if missing:
                raise HoigsError(
                    f"{path} is not a whole SMPL-X model: it lacks {', '.join(missing)} (found "
                    f"{', '.join(sorted(file.files)) or 'nothing'}); {_WHERE}"
                )
            arrays = {key: file[key] for key in _LAYOUT}
    except (ValueError, zipfile.BadZipFile) as error:  # pickles are refused with a ValueError
        raise HoigsError(f"{path} is not an SMPL-X .npz file ({error}); {_WHERE}") from error
    _check_shapes(path, arrays)
    return arrays


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    sizes: dict[str, int] = {}
    for key, layout in _LAYOUT.items():
        shape = arrays[key].shape
        expected = [sizes.get(n, n) if isinstance(n, str) else n for n in layout]
        fits = len(shape) == len(layout) and all(
            isinstance(want, str) or want == got for want, got in zip(expected, shape, strict=True)
        )
        if not fits:
            raise HoigsError(
                f"{path}: {key} has shape {list(shape)}, SMPL-X has {expected} there"
                + ("; SMPL and SMPL+H files do not fit" if 55 in layout or 486 in layout else "")
                + f"; {_WHERE}"
            )
        sizes.update({n: s for n, s in zip(layout, shape, strict=True) if isinstance(n, str)})
        if not np.isfinite(arrays[key]).all():
            raise HoigsError(f"{path}: {key} holds NaN or infinity; download the file again")
