"""CorrectedBody: what SMPL, SMPL+H and SMPL-X share beyond linear blend skinning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.bodies.linear import LinearBody
from hoigs.plugins.bodies.model_files import Layout, read_model, read_template, require_gender


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
        key: of the component, for messages. layout: of its model files. source: where to get them.
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
