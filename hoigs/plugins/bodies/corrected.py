"""CorrectedBody: what SMPL, SMPL+H and SMPL-X share beyond linear blend skinning."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.system.npz import plain_reason
from hoigs.core.values.clip import BodyTrack
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.linear import LinearBody

# The user's own model files of the SMPL family: reading and checking them.

Layout = Mapping[str, tuple[int | str, ...]]
HANDS = ("hands_meanl", "hands_meanr")  # where a file has them
GENDERS = ("female", "male", "neutral")


def read_model(key: str, path: Path, layout: Layout, where: str) -> dict[str, np.ndarray]:
    """The arrays of a model file, with their shapes checked; nothing is unpickled.

    Args:
        key: the component's key, for messages. where: a sentence on where such files come from.
        layout: shape of each array by its key; a letter has one value within a file.

    Raises:
        HoigsError: the file is absent, not an .npz file, or has another layout.
    """
    if not path.is_file():
        raise HoigsError(f"{key}: there is no file {path}; {where}")
    name = where.partition(" model files")[0]
    try:
        opened = np.load(path, allow_pickle=False)
        if not isinstance(opened, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with opened as file:
            missing = [k for k in layout if k not in file.files]
            if missing:
                raise HoigsError(
                    f"{path} is not a complete {name} model: it lacks {', '.join(missing)} (found "
                    f"{', '.join(sorted(file.files)) or 'nothing'}); {where}"
                )
            hands = [k for k in HANDS if k in file.files]
            arrays = {k: file[k] for k in (*layout, *hands)}
    except (ValueError, EOFError, OSError, OverflowError, zipfile.BadZipFile) as error:
        # pickles are refused with a ValueError
        reason = plain_reason(error)
        raise HoigsError(f"{path} is not an {name} .npz file ({reason}); {where}") from error
    own = {**layout, **dict.fromkeys(HANDS, (45,))} if hands else layout
    _check_shapes(path, arrays, own, name, where)
    return arrays


def _check_shapes(
    path: Path, arrays: Mapping[str, np.ndarray], layout: Layout, name: str, where: str
) -> None:
    sizes: dict[str, int] = {}
    for key, form in layout.items():
        if key not in arrays:
            raise HoigsError(f"{path}: it has one mean hand, but no {key}; {where}")
        if arrays[key].dtype.kind not in "biuf":
            raise HoigsError(f"{path}: {key} holds {arrays[key].dtype}, expected numbers; {where}")
        shape = arrays[key].shape
        expected = [sizes.get(n, n) if isinstance(n, str) else n for n in form]
        fits = len(shape) == len(form) and all(
            isinstance(size, str) or size == found
            for size, found in zip(expected, shape, strict=True)
        )
        if not fits:
            family = any(isinstance(n, int) and n > 3 for n in form)
            raise HoigsError(
                f"{path}: {key} has shape {list(shape)}, {name} has {expected} there"
                + ("; files of SMPL, SMPL+H and SMPL-X do not fit each other" if family else "")
                + f"; {where}"
            )
        sizes.update({n: s for n, s in zip(form, shape, strict=True) if isinstance(n, str)})
        if not np.isfinite(arrays[key]).all():
            raise HoigsError(f"{path}: {key} holds NaN or infinity; download the file again")


def read_template(path: Path) -> Float[Tensor, "V 3"]:
    """A person's zero-pose vertices from a mesh file, in the model's order, metres.

    Raises:
        HoigsError: the file is absent or not a mesh.
    """
    import trimesh

    if not path.is_file():
        raise HoigsError(f"{path}: no such file; `template` is a mesh of the model's vertices")
    try:
        mesh: Any = trimesh.load(path, process=False, maintain_order=True, allow_remote=False)
        points = np.asarray(mesh.vertices, dtype=np.float64)
    except Exception as error:  # trimesh raises errors of any kind on a damaged file
        raise HoigsError(f"{path} is not a mesh ({type(error).__name__}: {error})") from error
    return torch.from_numpy(points)


def file_gender(path: Path) -> str | None:
    """The gender in a model file's name or its folder's (SMPLX_MALE.npz, smplh/male/model.npz)."""
    for part in (path.stem, path.parent.name):
        words = re.split(r"[^a-z]+", part.lower())
        found = [g for g in GENDERS if g in words]
        if len(found) == 1:
            return found[0]
    return None


def require_gender(key: str, path: Path, track: BodyTrack | None) -> None:
    """Refuse a model file of another gender than that of the model the track was fitted with.

    A neutral body in place of a male or female one gives overlays that are visibly shifted
    (zc-alexfan/arctic#52). A file whose name has no gender is accepted.

    Raises:
        HoigsError: the file's name has another gender.
    """
    expected = track.gender if track else None
    found = file_gender(path)
    if expected is not None and found is not None and expected != found:
        raise HoigsError(
            f"{key}: the clip's poses were fitted with the {expected} model, {path} is the {found} "
            f"one; give the {expected} file"
        )


class ModelFileConfig(ComponentConfig):
    """A body model from the user's own file."""

    path: Path = Field(description="your model file (.npz), of the gender of the clip's poses")
    num_betas: int = Field(default=10, ge=1, le=300, description="shape coefficients in use")
    template: Path | None = Field(
        default=None,
        description="the person's own zero-pose mesh (ARCTIC's subject_vtemplates); by default the "
        "clip's, else the model's mean",
    )


class CorrectedBody(LinearBody):
    """A linear body with pose blendshapes and, if its file has one, a mean hand pose.

    A subclass declares the layout of its files and its joints.

    Args:
        template: the person's own vertices in the zero pose, metres, in place of the file's mean;
            that of the config, if there is one, is used in its place.

    Attributes:
        key: the component's key, for messages. layout: that of its model files. source: where they
            are published.
        hand_means: [2, 15, 3], the mean pose of left and right hand, axis-angle, or None. It is
            added to a BodyPose with hand_pose_convention="mean" (flat_hand_mean=False elsewhere).

    Raises:
        HoigsError: the file is absent, has another layout or fewer shape directions, or the
            template has another number of vertices.
    """

    Config: ClassVar = ModelFileConfig
    key: ClassVar[str]
    layout: ClassVar[Layout]
    source: ClassVar[str]
    names: ClassVar[Sequence[str]]

    pose_directions: Float[Tensor, "R D"]
    hand_means: Float[Tensor, "2 15 3"] | None

    def __init__(
        self, config: ModelFileConfig, *, template: Float[Tensor, "V 3"] | None = None
    ) -> None:
        file = self.adapted(read_model(self.key, config.path, self.layout, self.source))
        available = self.shape_directions_of(file)
        if config.num_betas > available:
            raise HoigsError(
                f"{config.path} has {available} shape directions, num_betas is {config.num_betas}"
            )
        mean = _tensor(file["v_template"])
        if config.template is not None:
            template = read_template(config.template)
        if template is not None and template.shape != mean.shape:
            raise HoigsError(
                f"template has {len(template)} vertices, the model {len(mean)}: give one in the "
                "model's own vertices"
            )
        vertices = mean if template is None else template.double()
        directions = _tensor(file["shapedirs"][:, :, : config.num_betas]).permute(2, 0, 1)
        regressor = _tensor(file["J_regressor"])
        parents = file["kintree_table"][0].astype(np.int64)
        super().__init__(
            template=vertices.float(),
            shape_directions=directions.float().contiguous(),
            joints=(regressor @ vertices).float(),
            joint_shape_directions=(regressor @ directions).float(),
            weights=_tensor(file["weights"]).float(),
            faces=torch.from_numpy(file["f"].astype(np.int64)),
            joint_names=self.names,
            parents=[-1, *parents[1:].tolist()],  # in files the root's parent is 2^32 - 1
        )
        rows = _tensor(file["posedirs"]).float().flatten(0, 1).T.contiguous()
        self.register_buffer("pose_directions", rows, persistent=False)
        means = None
        if "hands_meanl" in file:
            both = np.stack((file["hands_meanl"], file["hands_meanr"]))
            means = _tensor(both).float().unflatten(1, (15, 3))
        self.register_buffer("hand_means", means, persistent=False)

    @classmethod
    def from_config(cls, config: ModelFileConfig, context: BuildContext) -> Self:
        track = context.body_track
        require_gender(cls.key, config.path, track)
        return cls(config, template=None if track is None else track.template)

    def adapted(self, file: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The arrays of a model file, for the joints of this class."""
        return file

    def shape_directions_of(self, file: dict[str, np.ndarray]) -> int:
        """Number of shape directions in a model file."""
        return file["shapedirs"].shape[2]

    def flat_hands(self, pose: BodyPose) -> BodyPose:
        """The same pose in the "flat" hand convention, with the mean hand added if it is "mean".

        Raises:
            HoigsError: the pose is in the "mean" convention and the file has no mean hand.
        """
        if pose.hand_pose_convention == "flat" or self.hand_means is None:
            return super().flat_hands(pose)
        left, right = self.hand_means.to(pose.left_hand)
        return pose.replace(
            left_hand=pose.left_hand + left,
            right_hand=pose.right_hand + right,
            hand_pose_convention="flat",
        )

    def _pose_corrected(self, vertices: Tensor, rotations: Tensor) -> Tensor:
        """v + (R - I) of all joints but the root along the pose directions (SMPL-X, eq. 4)."""
        matrices = axis_angle_to_matrices(rotations[..., 1:, :])
        feature = (matrices - torch.eye(3).to(matrices)).flatten(-3)
        offset = feature @ self.pose_directions.to(feature)
        return vertices + offset.unflatten(-1, (-1, 3))


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float64))
