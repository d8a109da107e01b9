"""A moment as one row of numbers, so that time and poses reach a device in a single copy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.moment import BodyPose, HandConvention, Moment

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
        fields: of BodyPose that are in the row, in this order.
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
            row: from `pack`, without `first`, on any device. dtype: of the poses.
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
