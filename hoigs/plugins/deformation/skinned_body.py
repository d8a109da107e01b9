"""A human that a body model poses: its pose, its shape, its size and its skeleton."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from hoigs.core.config import ComponentConfig
from hoigs.core.device import Time
from hoigs.core.interfaces.body import (
    LEFT_FOOT,
    LEFT_WRIST,
    PELVIS,
    RIGHT_FOOT,
    RIGHT_WRIST,
    BodyModel,
    BodySurface,
)
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.frame_times import FrameTimes, TrainedFrames
from hoigs.core.maths.rotations import axis_angle_to_quats
from hoigs.core.maths.skinning import ancestor_table, transform_points
from hoigs.core.values.clip import POSES_EXACT, Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.plugins.deformation.irradiance import Irradiance


class FrameCorrections(nn.Module):
    """A small rigid motion for each frame; all start at the identity.

    Between trained frames they are interpolated, as in PoseRefinement.

    Args:
        count, trained, times: as TrainedFrames.
    """

    def __init__(
        self, count: int, trained: Sequence[int] | None = None, times: FrameTimes = None
    ) -> None:
        super().__init__()
        self.turns = nn.Parameter(torch.zeros(count, 3))
        self.shifts = nn.Parameter(torch.zeros(count, 3))
        self.frames = TrainedFrames(count, trained, times)

    def forward(self, time: Time) -> tuple[Float[Tensor, " 4"], Float[Tensor, " 3"]]:
        """Rotation (wxyz) and translation, metres."""
        turn = self.frames.between(self.turns, time)
        return axis_angle_to_quats(turn), self.frames.between(self.shifts, time)


# Learnable corrections of a clip's body poses (ExAvatar, Moon et al. 2024, arXiv:2407.21686).


class PoseRefinement(nn.Module):
    """Corrections of pose and translation for each frame, and one of shape; all start at zero.

    Between frames, and on frames that are not trained on, corrections are interpolated linearly
    from the nearest trained frames, so that the image of a test frame does not change its pose.

    Args:
        num_frames: F. betas: number of shape coefficients of the body.
        trained: frames that are trained on; all by default.
        times: times of the F frames, in [0, 1]; None: uniform.
    """

    def __init__(
        self,
        num_frames: int,
        betas: int,
        trained: Sequence[int] | None = None,
        times: FrameTimes = None,
    ) -> None:
        super().__init__()
        self.pose = nn.Parameter(torch.zeros(num_frames, 52, 3))
        self.transl = nn.Parameter(torch.zeros(num_frames, 3))
        self.betas = nn.Parameter(torch.zeros(betas))
        self.frames = TrainedFrames(num_frames, trained, times)

    def forward(self, pose: BodyPose, time: Time) -> BodyPose:
        """`pose` with the corrections at `time`.

        Rotations are added as axis-angle, which is close to composing them while they are small.
        """
        turn: Float[Tensor, "52 3"] = self.frames.between(self.pose, time)
        shift = self.frames.between(self.transl, time)
        return pose.with_residual(turn[1:]).replace(
            global_orient=pose.global_orient + turn[0],
            transl=pose.transl + shift,
            betas=pose.betas + self.betas,
        )


# metres: Gaussians made with another seed are decimetres off, those on a padded surface centimetres
APART = 0.05
ANCHORS = (PELVIS, LEFT_WRIST, RIGHT_WRIST, LEFT_FOOT, RIGHT_FOOT)


class PosedBody(NamedTuple):
    """A body at a moment, without the interaction's residual and without gradients.

    Attributes:
        pose: refined pose. transforms: its joint transforms, [J, 4, 4].
        vertices, joints: [V, 3] and [J, 3], of the zero pose in the shape of `pose`, metres.
    """

    pose: BodyPose
    transforms: Tensor
    vertices: Tensor
    joints: Tensor


class SkinnedBodyConfig(ComponentConfig):
    """Settings of all avatars."""

    refine_poses: bool | Literal["auto"] = True
    """Learn per-frame corrections of pose and translation, and one of shape. "auto" learns them
    unless the clip declares its poses to be exact, as a built-in clip without noise does:
    corrections of exact poses hide errors of the shape in the views that were filmed."""
    light: bool = False
    """Learn the light by the direction in which the surface faces (`Irradiance`), so that colours
    change as the person turns; False is the paper."""


class SkinnedBody(DeformationModel):
    """The pose of a human, its refinement, the scale alpha of HOIGS, Eq. 6, and the skeleton.

    Subclasses make their own modules in `_build`.

    Args:
        body: the body model; it is neither trained nor stored in checkpoints.
        entity: name of the human, under which a Moment has its pose.
        betas: shape of the canonical Gaussians; zeros by default.
        surface: points of the canonical Gaussians, where these are not
            `body.surface(count, betas, seed)`.
        seed: seed of that surface.
        num_frames: frames in the clip; needed to refine poses.
        trained_frames: frames whose poses are refined; all by default. The others follow
            (PoseRefinement).
        camera_centers: [F, 3], world, metres; needed to scale about the camera.
        frame_times: frame times in [0, 1]; None: uniform.

    Raises:
        ValueError: `refine_poses` without `num_frames`.
    """

    Config: ClassVar = SkinnedBodyConfig
    kinds = frozenset({"human"})
    provides = frozenset({"skeleton"})
    residuals = frozenset({"means", "pose"})
    input_space = "canonical"
    transient: ClassVar[Mapping[str, Any]] = {
        "_shape": None,
        "_arm": None,
        "_last_posed": None,
        "held": False,
    }
    learns_scale: ClassVar[bool] = False  # else the body keeps the size that the clip gives it

    config: Any  # of the subclass's Config
    betas: Tensor
    rest_vertices: Tensor
    rest_joints: Tensor
    ancestors: Tensor
    camera_centers: Tensor | None

    def __init__(
        self,
        config: SkinnedBodyConfig | None = None,
        *,
        body: BodyModel,
        entity: str = "human",
        betas: Float[Tensor, " B"] | None = None,
        surface: BodySurface | None = None,
        seed: int = 0,
        num_frames: int | None = None,
        trained_frames: Sequence[int] | None = None,
        camera_centers: Float[Tensor, "F 3"] | None = None,
        frame_times: FrameTimes = None,
    ) -> None:
        super().__init__()
        self.frame_times = frame_times
        self.config = config or self.Config()
        # in a tuple, so that the body is no submodule: its data belongs to no checkpoint
        self._body = (body,)
        self.entity, self.seed, self.num_frames = entity, seed, num_frames
        self._surface = surface
        self.log_alpha = nn.Parameter(torch.zeros(()), requires_grad=self.learns_scale)
        self.refinement: PoseRefinement | None = None
        if self.config.refine_poses:
            if num_frames is None:
                raise ValueError(
                    "refine_poses needs num_frames, the length of the clip; give it, or set "
                    "refine_poses to false"
                )
            self.refinement = PoseRefinement(
                num_frames, body.num_betas, trained_frames, frame_times
            )
        self.irradiance = Irradiance() if self.config.light else None
        betas = torch.zeros(body.num_betas) if betas is None else betas.detach().clone()
        with torch.no_grad():
            vertices, joints = body.shaped(betas)
        for name, value in {
            "betas": betas,
            "rest_vertices": vertices,
            "rest_joints": joints,
            "ancestors": ancestor_table(body.parents),
            "camera_centers": camera_centers,
        }.items():
            self.register_buffer(name, value, persistent=False)
        self._shape: tuple[Tensor, Tensor, Tensor] | None = None
        self._arm: tuple[Tensor, Tensor] | None = None
        self._last_posed: tuple[Moment, list[tuple[int, int]], PosedBody] | None = None
        self.held = False  # see `hold`
        self._build()

    def _build(self) -> None:
        """Make the modules of a subclass; called at the end of the constructor."""

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        if context.body is None:
            raise ValueError(
                f"{cls.__name__} needs a body model, and the context has none: it deforms entities "
                "of kind human"
            )
        if config.refine_poses == "auto":
            config = config.model_copy(update={"refine_poses": not exact_poses(context.clip)})
        return cls(config, body=context.body, **context_settings(context))

    @property
    def body(self) -> BodyModel:
        return self._body[0]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.body._apply(fn, recurse)
        self._shape = self._arm = self._last_posed = None
        self.held = False
        return super()._apply(fn, recurse)

    @torch.no_grad()
    def hold(self, canonical: Gaussians, moment: Moment) -> None:
        """Keep shape and arm length as they are at `moment`."""
        self.held = False
        betas = self.pose(moment).betas.detach().clone()
        self._shape = (betas, *self.body.shaped(betas))
        self.arm_length()
        self.held = True

    def train(self, mode: bool = True) -> Self:
        self.held, self._last_posed = False, None
        return super().train(mode)

    def pose(self, moment: Moment) -> BodyPose:
        """The pose that `moment` has for this human, refined; without the residual."""
        if self.entity not in moment.poses:
            raise ValueError(
                f'the moment has no body pose for "{self.entity}"; it has '
                f"{sorted(moment.poses) or 'none'}"
            )
        pose = moment.poses[self.entity]
        return pose if self.refinement is None else self.refinement(pose, moment.time)

    def shaped(self, betas: Float[Tensor, " B"], moment: Moment) -> tuple[Tensor, Tensor]:
        """Vertices [V, 3] and joints [J, 3] of the zero pose, metres.

        The last shape without gradient is cached, unless comparing with it would wait for the
        device.
        """
        if self.held and self._shape is not None:
            return self._shape[1], self._shape[2]
        if self.training and (self.refinement is not None or _time_on_device(moment)):
            return self.body.shaped(betas)  # the shape is another one at every step
        if betas.requires_grad and torch.is_grad_enabled():
            return self.body.shaped(betas)
        if self._shape is None or not torch.equal(self._shape[0], betas):
            self._shape = (betas.detach().clone(), *self.body.shaped(betas.detach()))
        return self._shape[1], self._shape[2]

    def reshaped(self, betas: Float[Tensor, " B"], moment: Moment) -> bool:
        """Whether these betas may differ from those of the canonical Gaussians.

        True, too, where comparing them would wait for the device.
        """
        if betas.requires_grad or self.held or (self.training and _time_on_device(moment)):
            return True
        return not torch.equal(betas, self.betas)

    @torch.no_grad()
    def posed_body(self, moment: Moment) -> PosedBody:
        """The body at `moment`; kept for `anchors`, which the same forward pass calls next."""
        pose = self.pose(moment)
        shape = self.shaped(pose.betas, moment)
        found = PosedBody(pose, self.body.skinning_transforms(pose), *shape)
        self._last_posed = (moment, self._state(), found)
        return found

    def _state(self) -> list[tuple[int, int]]:
        """Differs after every change of the refinement, except by a fused optimizer."""
        if self.refinement is None:
            return []
        return [(p.data_ptr(), p._version) for p in self.refinement.parameters()]

    def posed_joints(
        self,
        places: Float[Tensor, "J 3"],
        transforms: Float[Tensor, "J 4 4"],
        joints: tuple[int, ...],
    ) -> Float[Tensor, "A 3"]:
        """World positions of some joints, before alpha; `places`: of all, in the zero pose."""
        posed = transform_points(transforms, places)
        return torch.stack([posed[joint] for joint in joints])

    def scaled(
        self, points: Float[Tensor, "N 3"], pelvis: Float[Tensor, " 3"], moment: Moment
    ) -> Float[Tensor, "N 3"]:
        """World points scaled by alpha."""
        center = self.scale_center(pelvis, moment)
        return center + self.log_alpha.exp() * (points - center)

    def scaled_transforms(
        self, transforms: Float[Tensor, "J 4 4"], pelvis: Float[Tensor, " 3"], moment: Moment
    ) -> Float[Tensor, "J 4 4"]:
        """Transforms that also scale by alpha, as `scaled` does."""
        alpha = self.log_alpha.exp()
        rest = (1 - alpha) * self.scale_center(pelvis, moment)
        return alpha * transforms + pad(rest[:, None], (3, 0, 0, 1))

    def scale_center(self, pelvis: Float[Tensor, " 3"], moment: Moment) -> Float[Tensor, " 3"]:
        """The fixed point of alpha in the world."""
        return pelvis

    @torch.no_grad()
    def anchors(self, moment: Moment) -> Float[Tensor, "A 3"]:
        """Pelvis, wrists and feet in the world, without gradient."""
        last = self._last_posed
        valid = last is not None and last[0] is moment and last[1] == self._state()
        posed = last[2] if last is not None and valid else self.posed_body(moment)
        self._last_posed = None  # used once: fused optimizers change poses without a trace
        joints = self.posed_joints(posed.joints, posed.transforms, ANCHORS)
        return self.scaled(joints, joints[0], moment)

    def arm_length(self) -> Float[Tensor, ""]:
        return self._arm_at_rest() * self.log_alpha.exp()

    def _arm_at_rest(self) -> Float[Tensor, ""]:
        if self._arm is not None and (self.held or self.refinement is None):
            return self._arm[1]
        betas = self.betas
        if self.refinement is not None:
            betas = betas + self.refinement.betas.detach()
            # in training the shape changes at every step and comparing would wait for the device
            if self.training:
                return self.body.arm_length(betas)
        if self._arm is None or not torch.equal(self._arm[0], betas):
            self._arm = (betas.clone(), self.body.arm_length(betas))
        return self._arm[1]


def _time_on_device(moment: Moment) -> bool:
    """Whether time is a tensor, as while a CUDA graph is captured: the host must not wait then."""
    return isinstance(moment.time, Tensor)


def exact_poses(clip: Clip | None) -> bool:
    """Whether the clip declares that its body poses have no error."""
    return clip is not None and clip.provenance.get(POSES_EXACT) is True


def context_settings(context: BuildContext) -> dict[str, Any]:
    """Arguments of SkinnedBody that the context decides, except the body."""
    settings: dict[str, Any] = {"entity": context.entity, "seed": context.seed}
    if context.body_track is not None:
        betas = context.body_track.poses.betas
        settings["betas"] = betas if betas.dim() == 1 else betas.mean(0)
        settings["num_frames"] = len(context.body_track.poses.transl)
    if context.clip is not None:
        settings |= clip_settings(context.clip)
    return settings


def checked_surface(surface: BodySurface, canonical: Gaussians) -> BodySurface:
    """`surface`, if the canonical Gaussians lie on it.

    Raises:
        ValueError: it has another number of points, or they are elsewhere.
    """
    if len(surface.points) != len(canonical):
        raise ValueError(
            f"{len(canonical)} canonical Gaussians, but a surface of {len(surface.points)} points"
        )
    apart = (surface.points - canonical.means.detach()).norm(dim=-1)
    if len(apart) and apart.median() > APART:
        raise ValueError(
            f"the canonical Gaussians are {apart.median():.2f} m from the surface that has their "
            "skinning weights; make them with body.canonical(count, betas, seed) of the same betas "
            "and seed, or give their `surface`"
        )
    return surface


def clip_settings(clip: Clip) -> dict[str, Any]:
    """Arguments of SkinnedBody that a clip decides."""
    train = {clip.moments[i].index for i in clip.split.get("train", range(len(clip)))}
    by_frame = {m.index: c for m, c in zip(clip.moments, clip.cameras, strict=True)}
    return {
        "num_frames": clip.num_frames,
        "trained_frames": sorted(train),
        "frame_times": clip.frame_times,
        "camera_centers": torch.stack([by_frame[i].center for i in sorted(by_frame)]),
    }
