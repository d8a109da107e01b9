"""CorrectedBody: what SMPL, SMPL+H and SMPL-X share beyond linear blend skinning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clip import BodyTrack
from hoigs.core.errors import HoigsError
from hoigs.core.moment import BodyPose
from hoigs.core.rotation import axis_angle_to_matrices
from hoigs.plugins.bodies.linear import LinearBody
from hoigs.plugins.bodies.model_files import read_template


class CorrectedBody(LinearBody):
    """A linear body with pose blendshapes and, where its file has one, a mean hand.

    Args:
        file: v_template [V, 3], shapedirs [V, 3, S], J_regressor [J, V], weights [V, J], f [F, 3],
            and hands_meanl, hands_meanr [45] if it has them.
        template: a person's own vertices in place of v_template, metres.
        pose_directions: [V, 3, 9 (J - 1)], along (R - I) of joints 1..J-1.

    Attributes:
        hand_means: [2, 15, 3] axis-angle, or None: the file has no mean hand.
    """

    pose_directions: Float[Tensor, "R D"]
    hand_means: Float[Tensor, "2 15 3"] | None

    def __init__(
        self,
        file: Mapping[str, np.ndarray],
        *,
        num_betas: int,
        template: Float[Tensor, "V 3"] | None,
        pose_directions: Float[Tensor, "W 3 R"],
        joint_names: Sequence[str],
        parents: Sequence[int],
    ) -> None:
        mean = _tensor(file["v_template"])
        if template is not None and template.shape != mean.shape:
            raise HoigsError(
                f"template has {len(template)} vertices, the model {len(mean)}: give one in the "
                "model's own vertices"
            )
        vertices = mean if template is None else template.double()
        directions = _tensor(file["shapedirs"][:, :, :num_betas]).permute(2, 0, 1)
        regressor = _tensor(file["J_regressor"])
        super().__init__(
            template=vertices.float(),
            shape_directions=directions.float().contiguous(),
            joints=(regressor @ vertices).float(),
            joint_shape_directions=(regressor @ directions).float(),
            weights=_tensor(file["weights"]).float(),
            faces=torch.from_numpy(file["f"].astype(np.int64)),
            joint_names=joint_names,
            parents=parents,
        )
        rows = pose_directions.float().flatten(0, 1).T.contiguous()
        self.register_buffer("pose_directions", rows, persistent=False)
        means = None
        if "hands_meanl" in file:
            both = np.stack((file["hands_meanl"], file["hands_meanr"]))
            means = _tensor(both).float().unflatten(1, (15, 3))
        self.register_buffer("hand_means", means, persistent=False)

    def flat_hands(self, pose: BodyPose) -> BodyPose:
        """The same pose in the "flat" hand convention: the mean hand is added where it is due.

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


def own_template(path: Path | None, track: BodyTrack | None) -> Float[Tensor, "V 3"] | None:
    """The person's own zero-pose vertices: the settings' file, else the clip's, else None."""
    if path is not None:
        return read_template(path)
    return None if track is None else track.template


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float64))
