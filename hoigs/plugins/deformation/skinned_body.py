"""A human that is posed by a body model: what every skinned deformation shares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.body import (
    LEFT_FOOT,
    LEFT_WRIST,
    PELVIS,
    RIGHT_FOOT,
    RIGHT_WRIST,
    BodyModel,
    BodySurface,
)
from hoigs.core.clip import Clip
from hoigs.core.clock import Time, constant
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import BodyPose, Moment
from hoigs.core.skinning import transform_points
from hoigs.plugins.deformation.pose_refinement import PoseRefinement
from hoigs.plugins.deformation.skinning import ancestry

ScaleAbout = Literal["pelvis", "camera"]

APART = 0.05  # metres; rest made with another seed is decimetres off, a padded one centimetres
ANCHORS = (PELVIS, LEFT_WRIST, RIGHT_WRIST, LEFT_FOOT, RIGHT_FOOT)


class Stance(NamedTuple):
    """A body at a moment, without the interaction and without gradients.

    Attributes:
        pose: refined. transforms: of its joints [J, 4, 4].
        vertices [V, 3], joints [J, 3]: of the zero pose, in the pose's shape, metres.
    """

    pose: BodyPose
    transforms: Tensor
    vertices: Tensor
    joints: Tensor


class SkinnedBody(DeformationModel):
    """Poses by entity name, their refinement, the learnable scale alpha, and the skeleton.

    Args:
        body: the skinned body; neither trained nor stored in checkpoints.
        entity: name of the human, under which moments carry its pose.
        betas: shape for which rest was made; zeros when absent.
        num_frames: of the clip; needed to refine poses.
        trained_frames: frames whose poses are refined; the others follow (PoseRefinement).
        camera_centers: [F, 3], metres, needed to scale about the camera.
        refine_poses: learn corrections of pose, translation and shape.
        scale_about: the fixed point of alpha = exp(log_alpha): the "pelvis", or the "camera".
    """

    provides = frozenset({"skeleton"})
    residuals = frozenset({"means", "pose"})
    rest_space = "canonical"

    betas: Tensor
    rest_vertices: Tensor
    rest_joints: Tensor
    ancestors: Tensor
    camera_centers: Tensor | None

    def __init__(
        self,
        body: BodyModel,
        *,
        entity: str,
        betas: Float[Tensor, " B"] | None,
        num_frames: int | None,
        trained_frames: Sequence[int] | None,
        camera_centers: Float[Tensor, "F 3"] | None,
        refine_poses: bool,
        scale_about: ScaleAbout,
    ) -> None:
        super().__init__()
        if scale_about == "camera" and camera_centers is None:
            raise ValueError('scale_about "camera" needs camera_centers, one a frame')
        # in a tuple, so that the body is no submodule: its data belongs to no checkpoint
        self._body = (body,)
        self.entity = entity
        self.log_alpha = nn.Parameter(torch.zeros(()))
        self.refinement: PoseRefinement | None = None
        if refine_poses:
            if num_frames is None:
                raise ValueError("refine_poses needs num_frames, the length of the clip")
            self.refinement = PoseRefinement(num_frames, body.num_betas, trained_frames)
        betas = torch.zeros(body.num_betas) if betas is None else betas.detach().clone()
        with torch.no_grad():
            vertices, joints = body.shaped(betas)
        for name, value in {
            "betas": betas,
            "rest_vertices": vertices,
            "rest_joints": joints,
            "ancestors": ancestry(body.parents),
            "camera_centers": camera_centers if scale_about == "camera" else None,
        }.items():
            self.register_buffer(name, value, persistent=False)
        self._shape: tuple[Tensor, Tensor, Tensor] | None = None
        self._arm: tuple[Tensor, Tensor] | None = None
        self._asked: tuple[Moment, list[tuple[int, int]], Stance] | None = None
        self.held = False  # see `hold`

    @property
    def body(self) -> BodyModel:
        return self._body[0]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.body._apply(fn, recurse)
        self._shape = self._arm = self._asked = None
        self.held = False
        return super()._apply(fn, recurse)

    @torch.no_grad()
    def hold(self, rest: Gaussians, moment: Moment) -> None:
        """Shape and arm length of this moment's person, from now on."""
        self.held = False
        betas = self.pose(moment).betas.detach().clone()
        self._shape = (betas, *self.body.shaped(betas))
        self.arm_length()
        self.held = True

    def train(self, mode: bool = True) -> Self:
        self.held, self._asked = False, None
        return super().train(mode)

    def set_trained_frames(self, indices: Sequence[int]) -> None:
        """Frames whose poses are refined; the others are interpolated from these."""
        if self.refinement is not None:
            self.refinement.set_trained_frames(indices)

    def pose(self, moment: Moment) -> BodyPose:
        """The pose that `moment` brings for this human, refined; without the interaction."""
        if self.entity not in moment.poses:
            raise ValueError(
                f'the moment has no body pose for "{self.entity}"; it has '
                f"{sorted(moment.poses) or 'none'}"
            )
        pose = moment.poses[self.entity]
        return pose if self.refinement is None else self.refinement(pose, moment.time)

    def shaped(self, betas: Float[Tensor, " B"], moment: Moment) -> tuple[Tensor, Tensor]:
        """Vertices [V, 3] and joints [J, 3] of the zero pose, metres; the last shape without
        gradient is kept, where to compare it does not wait for the device."""
        if self.held and self._shape is not None:
            return self._shape[1], self._shape[2]
        if self.training and (self.refinement is not None or _recorded(moment)):
            return self.body.shaped(betas)  # another one at every step
        if betas.requires_grad and torch.is_grad_enabled():
            return self.body.shaped(betas)
        if self._shape is None or not torch.equal(self._shape[0], betas):
            self._shape = (betas.detach().clone(), *self.body.shaped(betas.detach()))
        return self._shape[1], self._shape[2]

    def reshaped(self, betas: Float[Tensor, " B"], moment: Moment) -> bool:
        """Whether these are other betas than those that rest was made for; so, too, where to
        compare them would wait for the device."""
        if betas.requires_grad or self.held or (self.training and _recorded(moment)):
            return True
        return not torch.equal(betas, self.betas)

    @torch.no_grad()
    def stance(self, moment: Moment) -> Stance:
        """The body at `moment`; kept for `anchors`, which the same forward pass asks for next."""
        pose = self.pose(moment)
        shape = self.shaped(pose.betas, moment)
        found = Stance(pose, self.body.skinning_transforms(pose), *shape)
        self._asked = (moment, self._state(), found)
        return found

    def _state(self) -> list[tuple[int, int]]:
        """Changes with the values that a pose is made of, unless a fused optimizer made them."""
        if self.refinement is None:
            return []
        return [(p.data_ptr(), p._version) for p in self.refinement.parameters()]

    def posed_joints(
        self,
        places: Float[Tensor, "J 3"],
        transforms: Float[Tensor, "J 4 4"],
        joints: tuple[int, ...],
    ) -> Float[Tensor, "A 3"]:
        """World positions of some joints, before alpha; `places` of all in the zero pose."""
        chosen = constant(joints, places, torch.long)
        return transform_points(transforms.index_select(0, chosen), places.index_select(0, chosen))

    def scaled(
        self, points: Float[Tensor, "N 3"], pelvis: Float[Tensor, " 3"], moment: Moment
    ) -> Float[Tensor, "N 3"]:
        """alpha: points scaled about the pelvis, or along the rays of the camera."""
        center = pelvis
        if self.camera_centers is not None:
            center = at_frame(self.camera_centers, moment.time)
        return center + self.log_alpha.exp() * (points - center)

    @torch.no_grad()
    def anchors(self, moment: Moment) -> Float[Tensor, "A 3"]:
        """Pelvis, wrists and feet in the world, without gradient."""
        asked = self._asked
        known = asked is not None and asked[0] is moment and asked[1] == self._state()
        stance = asked[2] if asked is not None and known else self.stance(moment)
        self._asked = None  # handed out once: fused optimizers change poses without a trace
        joints = self.posed_joints(stance.joints, stance.transforms, ANCHORS)
        return self.scaled(joints, joints[0], moment)

    def arm_length(self) -> Float[Tensor, ""]:
        return self._arm_at_rest() * self.log_alpha.exp()

    def _arm_at_rest(self) -> Float[Tensor, ""]:
        if self._arm is not None and (self.held or self.refinement is None):
            return self._arm[1]
        betas = self.betas
        if self.refinement is not None:
            betas = betas + self.refinement.betas.detach()
            # in training the shape changes at every step, and comparing would wait for the device
            if self.training:
                return self.body.arm_length(betas)
        if self._arm is None or not torch.equal(self._arm[0], betas):
            self._arm = (betas.clone(), self.body.arm_length(betas))
        return self._arm[1]


def _recorded(moment: Moment) -> bool:
    """Whether the host is told no time: it would be that of the recording (hoigs.core.clock)."""
    return isinstance(moment.time, Tensor)


def context_settings(context: BuildContext, what: str) -> dict[str, Any]:
    """Constructor arguments that the clip decides: entity, seed, betas, num_frames, and those of
    `clip_settings`.

    Raises:
        ValueError: no body; `what` names the component.
    """
    if context.body is None:
        raise ValueError(f"{what} needs a body; it suits entities of kind human")
    settings: dict[str, Any] = {"entity": context.entity, "seed": context.seed}
    if context.body_track is not None:
        betas = context.body_track.poses.betas
        settings["betas"] = betas if betas.dim() == 1 else betas.mean(0)
        settings["num_frames"] = len(context.body_track.poses.transl)
    if context.clip is not None:
        settings |= clip_settings(context.clip)
    return settings


def checked_surface(surface: BodySurface, rest: Gaussians) -> BodySurface:
    """`surface`, if rest Gaussians were made of it.

    Raises:
        ValueError: another count, or the points stand apart.
    """
    if len(surface.points) != len(rest):
        raise ValueError(
            f"{len(rest)} rest Gaussians, but a surface of {len(surface.points)} points"
        )
    apart = (surface.points - rest.means.detach()).norm(dim=-1)
    if len(apart) and apart.median() > APART:
        raise ValueError(
            f"rest Gaussians stand {apart.median():.2f} m from the surface that weights them; "
            "make rest with body.rest(count, betas, seed) of the same betas "
            "and seed, or pass its `surface`"
        )
    return surface


def at_frame(values: Float[Tensor, "F ..."], time: Time) -> Float[Tensor, "..."]:
    """The value of the frame nearest to a time in [0, 1]."""
    last = len(values) - 1
    if isinstance(time, Tensor):
        nearest = (time * last).round().clamp(0, last).long()
        return values.index_select(0, nearest).squeeze(0)
    return values[min(max(round(time * last), 0), last)]


def clip_settings(clip: Clip) -> dict[str, Any]:
    """What a clip says of the arguments of SkinnedBody."""
    train = {clip.moments[i].index for i in clip.split.get("train", range(len(clip)))}
    by_frame = {m.index: c for m, c in zip(clip.moments, clip.cameras, strict=True)}
    return {
        "num_frames": clip.num_frames,
        "trained_frames": sorted(train),
        "camera_centers": torch.stack([by_frame[i].center for i in sorted(by_frame)]),
    }
