"""A moment: a time, and the body poses at that time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_quats, multiply_quats, quats_to_axis_angle
from hoigs.core.values.shown import one_line

HandConvention = Literal["flat", "mean"]
ResidualRule = Literal["add", "compose"]


@dataclass(frozen=True)
class BodyPose:
    """Body parameters in the SMPL-X convention, axis-angle in radians (Pavlakos et al. 2019).

    Every field may carry leading batch dimensions (frames); `betas` may omit them.

    Attributes:
        global_orient: rotation about the pelvis joint.
        body: joints 1..21. left_hand, right_hand: 15 joints each.
        transl: added last, metres; the pelvis in the world is J_0(betas) + transl.
        betas: shape coefficients of the body model in use.
        hand_pose_convention: "flat" when zero means a flat hand, "mean" when zero means the
            model's mean hand (SMPL-X flat_hand_mean=False).
    """

    global_orient: Float[Tensor, "*batch 3"]
    body: Float[Tensor, "*batch 21 3"]
    left_hand: Float[Tensor, "*batch 15 3"]
    right_hand: Float[Tensor, "*batch 15 3"]
    transl: Float[Tensor, "*batch 3"]
    betas: Float[Tensor, "*shape B"]
    hand_pose_convention: HandConvention = "flat"

    __repr__ = one_line

    @staticmethod
    def zeros(*batch: int, betas: int = 10, **kwargs: Any) -> BodyPose:
        """The rest pose at the origin; kwargs (dtype, device) go to torch.zeros."""
        z = lambda *shape: torch.zeros(*batch, *shape, **kwargs)  # noqa: E731
        return BodyPose(z(3), z(21, 3), z(15, 3), z(15, 3), z(3), torch.zeros(betas, **kwargs))

    @property
    def rotations(self) -> Float[Tensor, "*batch 52 3"]:
        """Global orientation, body, left hand, right hand: one axis-angle a joint."""
        return torch.cat(
            (self.global_orient[..., None, :], self.body, self.left_hand, self.right_hand), -2
        )

    def with_residual(self, pose: Float[Tensor, "51 3"], rule: ResidualRule = "add") -> BodyPose:
        """theta + delta theta on body and hands (HOIGS, Sec. "Interaction Module").

        Args:
            pose: delta theta, radians.
            rule: "add" axis-angles, as the paper prints it, which is close to composing while
                corrections are small; "compose" turns by delta theta after theta.
        """
        theta = torch.cat((self.body, self.left_hand, self.right_hand), -2)
        if rule == "add":
            theta = theta + pose
        else:
            after, before = axis_angle_to_quats(pose), axis_angle_to_quats(theta)
            theta = quats_to_axis_angle(multiply_quats(after.expand_as(before), before))
        body, left, right = theta.split((21, 15, 15), -2)
        return replace(self, body=body, left_hand=left, right_hand=right)

    def map(self, function: Callable[[Tensor], Tensor]) -> BodyPose:
        changed: dict[str, Any] = {
            f.name: function(getattr(self, f.name))
            for f in fields(self)
            if f.name != "hand_pose_convention"
        }
        return replace(self, **changed)

    def frame(self, index: int | slice | Tensor) -> BodyPose:
        """One frame of a batched pose, or some; betas without a batch are shared."""
        shared = self.betas if self.betas.dim() == 1 else self.betas[index]
        return replace(
            self,
            global_orient=self.global_orient[index],
            body=self.body[index],
            left_hand=self.left_hand[index],
            right_hand=self.right_hand[index],
            transl=self.transl[index],
            betas=shared,
        )

    def to(self, *args: Any, **kwargs: Any) -> BodyPose:
        return self.map(lambda x: x.to(*args, **kwargs))

    def replace(self, **changes: Any) -> BodyPose:
        return replace(self, **changes)


@dataclass(frozen=True)
class Moment:
    """A time, and the pose of every body at it.

    Attributes:
        time: in [0, 1] over the clip: frame / (frames - 1), or the frame's true time where a clip
            has one (`Clip.frame_times`). Under CUDA graphs it is a 0-d tensor on
            the device (`hoigs.core.fast.graphs`); `float(moment.time)` is a number
            in either case, but no CUDA graph can capture it.
        index: frame number; for a time between frames, the nearest.
        poses: body pose by entity name, unbatched.
    """

    time: float
    index: int = 0
    poses: Mapping[str, BodyPose] = field(default_factory=dict)

    __repr__ = one_line

    def to(self, *args: Any, **kwargs: Any) -> Moment:
        return replace(self, poses={k: p.to(*args, **kwargs) for k, p in self.poses.items()})

    def with_pose(self, entity: str, pose: BodyPose) -> Moment:
        return replace(self, poses={**self.poses, entity: pose})


# A moment as one row of numbers, so that time and poses reach a device in a single copy.


POSE = ("global_orient", "body", "left_hand", "right_hand", "transl")


@dataclass(frozen=True)
class Person:
    """The hand convention of a pose and the shapes of its fields, which the row does not hold."""

    convention: HandConvention
    shapes: tuple[torch.Size, ...]


@dataclass(frozen=True)
class MomentLayout:
    """The order of a moment's numbers in a row: the time first, then each person's pose.

    Attributes:
        people: by entity name, in the row's order.
        fields: names of the fields of BodyPose in the row, in this order.
    """

    people: Mapping[str, Person]
    fields: tuple[str, ...] = POSE

    @staticmethod
    def of(moment: Moment, names: Iterable[str], *, betas: bool = False) -> MomentLayout:
        """The layout of moments like this one.

        Args:
            names: entities whose poses are in the row. betas: whether shapes are in it too.
        """
        chosen, fields = set(names), (*POSE, "betas") if betas else POSE
        people = {
            name: Person(pose.hand_pose_convention, tuple(getattr(pose, f).shape for f in fields))
            for name, pose in moment.poses.items()
            if name in chosen
        }
        return MomentLayout(people, fields)

    def fits(self, moment: Moment) -> bool:
        """Whether a moment has poses of these people, with these shapes and conventions."""
        for name, person in self.people.items():
            pose = moment.poses.get(name)
            if pose is None or pose.hand_pose_convention != person.convention:
                return False
            shapes = (getattr(pose, f).shape for f in self.fields)
            if any(ours != theirs for ours, theirs in zip(person.shapes, shapes, strict=True)):
                return False
        return True

    def pack(self, moment: Moment, *first: Tensor) -> Float[Tensor, " P"]:
        """The row on the CPU, in float64 for all inputs; `first` comes before it."""
        parts = [*first, torch.tensor([float(moment.time)], dtype=torch.float64)]
        for name in self.people:
            parts += [getattr(moment.poses[name], f) for f in self.fields]
        return torch.cat([x.detach().reshape(-1).to("cpu", torch.float64) for x in parts])

    def unpack(
        self,
        row: Float[Tensor, " P"],
        dtype: torch.dtype,
        given: Mapping[str, Mapping[str, Tensor]] | None = None,
    ) -> Moment:
        """The moment of a row, with the time as a 0-d tensor.

        Args:
            row: from `pack`, without `first`, on any device. dtype: that of the poses.
            given: fields that are not in the row, by person.
        """
        single = row.to(dtype)
        poses, start = {}, 1
        for name, person in self.people.items():
            values: dict[str, Any] = dict((given or {}).get(name, {}))
            for f, shape in zip(self.fields, person.shapes, strict=True):
                values[f] = single[start : start + shape.numel()].view(shape)
                start += shape.numel()
            poses[name] = BodyPose(**values, hand_pose_convention=person.convention)
        return Moment(cast(float, row[0]), 0, poses)
