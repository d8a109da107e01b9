"""Parameters of the SMPL family to BodyPose and back, exactly.

SMPL (24 joints), SMPL+H (52) and SMPL-X (55) share the first 22 joints, their tree and their axes,
so rotations carry over as they are. Shape coefficients and `transl` (the pelvis is J_0(betas) +
transl) belong to one model: a track keeps the name of the model that they are for, and
everything that reads the track checks `BodyTrack.model`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.values.moment import BodyPose, HandConvention

# of a hand's 15 joints, in SMPL-X's order: the first joint of index, middle, pinky, ring, thumb.
# SMPL turns a hand as one block at its knuckles; thumbs stand elsewhere and are part of the block.
KNUCKLES = (0, 3, 6, 9, 12)
OFF = 0.005  # metres
ANOTHER_PERSON = 3.0  # in standard deviations of people, which betas count


def pose_from_smplx(
    parameters: Mapping[str, Float[Tensor, "..."]], hands: HandConvention
) -> BodyPose:
    """SMPL-X parameters, flat or by joint, batched over frames.

    Jaw, eyes and expression have no place in a BodyPose and are left out: bodies here have none.

    Args:
        parameters: global_orient [F, 3], body_pose [F, 63], left_hand_pose, right_hand_pose
            [F, 45], transl [F, 3], betas [B]; axis-angle, radians; metres.
        hands: "flat" for flat_hand_mean=True, "mean" for False.

    Raises:
        ClipError: one is absent or has another width (hand PCA components are not pose).
    """
    widths = {
        "global_orient": 3, "body_pose": 63, "left_hand_pose": 45, "right_hand_pose": 45,
        "transl": 3,
    }  # fmt: skip
    flat = {}
    for name, width in widths.items():
        if name not in parameters:
            raise ClipError(f"SMPL-X parameters lack {name}; there are {sorted(parameters)}")
        values = parameters[name]
        values = values.reshape(len(values), -1)
        if values.shape[1] != width:
            hint = (
                ": PCA components of a hand; write them out as 45 angles" if "hand" in name else ""
            )
            raise ClipError(f"{name} has {values.shape[1]} numbers a frame, expected {width}{hint}")
        flat[name] = values
    return BodyPose(
        global_orient=flat["global_orient"],
        body=flat["body_pose"].unflatten(-1, (21, 3)),
        left_hand=flat["left_hand_pose"].unflatten(-1, (15, 3)),
        right_hand=flat["right_hand_pose"].unflatten(-1, (15, 3)),
        transl=flat["transl"],
        betas=parameters["betas"],
        hand_pose_convention=hands,
    )


def pose_from_smplh(
    pose: Float[Tensor, "*batch 156"],
    transl: Float[Tensor, "*batch 3"],
    betas: Float[Tensor, "*shape B"],
    hands: HandConvention = "mean",
) -> BodyPose:
    """SMPL+H parameters: 52 joints, exactly those of a BodyPose.

    Args:
        pose: axis-angle of the joints in order, radians.
        hands: "mean" as the MANO release has it (its pickled model adds the mean hand).
    """
    orient, body, left, right = pose.unflatten(-1, (52, 3)).split((1, 21, 15, 15), -2)
    return BodyPose(orient.squeeze(-2), body, left, right, transl, betas, hands)


def pose_from_smpl(
    pose: Float[Tensor, "*batch 72"],
    transl: Float[Tensor, "*batch 3"],
    betas: Float[Tensor, "*shape B"],
) -> BodyPose:
    """SMPL parameters: 24 joints; its two hand joints turn all knuckles of a hand alike.

    `body:smpl` undoes exactly that, so nothing is lost on the way.

    Args:
        pose: axis-angle of the joints in order, radians.
    """
    joints = pose.unflatten(-1, (24, 3))
    orient, body, ends = joints.split((1, 21, 2), -2)
    left, right = (_block(ends[..., i, :]) for i in (0, 1))
    return BodyPose(orient.squeeze(-2), body, left, right, transl, betas, "flat")


def moved_pose(
    pose: BodyPose,
    pelvis: Float[Tensor, " 3"],
    rotation: Float[Tensor, "*batch 3 3"],
    translation: Float[Tensor, "*batch 3"],
) -> BodyPose:
    """The pose in another world, x' = R x + t: transl' = R (J_0 + transl) + t - J_0.

    Args:
        pelvis: J_0(betas), the pelvis in the zero pose, of the model that the pose is for.
        rotation, translation: from the old world to the new one, one for all frames or one each.
    """
    orient = matrices_to_axis_angle(rotation @ axis_angle_to_matrices(pose.global_orient))
    place = (rotation @ (pelvis + pose.transl)[..., None])[..., 0] + translation
    return pose.replace(global_orient=orient, transl=place - pelvis)


@torch.no_grad()
def betas_of_joints(body: BodyModel, joints: Float[Tensor, "22 3"]) -> Float[Tensor, " B"]:
    """The shape whose zero-pose body joints are these, by least squares; their place is free.

    Raises:
        ClipError: some joint stays more than OFF metres off: another model or gender.
    """
    zeros = torch.zeros(body.num_betas, dtype=torch.float64)
    shapes = torch.cat((zeros[None], torch.eye(body.num_betas, dtype=torch.float64)))
    all_joints = body.shaped(shapes)[1][:, :22].double()
    all_joints = all_joints - all_joints[:, :1]
    base, moves = all_joints[0], all_joints[1:] - all_joints[0]
    target = joints.double() - joints[0].double() - base
    betas = torch.linalg.lstsq(moves.flatten(1).T, target.flatten()[:, None]).solution[:, 0]
    off = float((torch.einsum("b,bja->ja", betas, moves) - target).norm(dim=-1).max())
    if off > OFF:
        raise ClipError(
            f"zero-pose joints are not this model's: one is {1000 * off:.0f} mm off whatever the "
            "shape; is it the right model, and the right gender?"
        )
    return betas.float()


def same_betas(betas: Sequence[Float[Tensor, " B"]], what: str) -> Float[Tensor, " B"]:
    """The one shape of a person, from files with one for every frame: the median.

    Fits of single frames differ a little; a jump means that another person was fitted.

    Raises:
        ClipError: some frame's are further than ANOTHER_PERSON from it.
    """
    stacked = torch.stack(list(betas))
    middle = stacked.median(0).values
    spread = float((stacked - middle).abs().max())
    if spread > ANOTHER_PERSON:
        frame = int((stacked - middle).abs().amax(1).argmax())
        raise ClipError(
            f"{what}: betas of frame {frame} differ from the median by {spread:.2f}; one person "
            "has one shape"
        )
    return middle


def _block(turn: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 15 3"]:
    """A hand whose knuckles all turn alike."""
    hand = turn.new_zeros(*turn.shape[:-1], 15, 3)
    hand[..., KNUCKLES, :] = turn[..., None, :]
    return hand
