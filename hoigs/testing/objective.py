"""Conformance of objectives: `CHECKS`, on a tiny synthetic scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.objective import Objective, TrainingMoment, Weighted
from hoigs.core.model.scene import SceneModel
from hoigs.testing.checks import CheckError, CheckList, ComponentSubject, require, require_finite
from hoigs.testing.material import HUMAN, OBJECT, tiny_clip, tiny_scene
from hoigs.testing.modules import unchanged
from hoigs.testing.runner import Options


@dataclass(frozen=True)
class ObjectiveSubject(ComponentSubject[Objective]):
    """The component under check."""

    def objective(self) -> Objective:
        return self.cls.from_config(self.config, BuildContext(clip=tiny_clip()))

    def step(self, position: int, *, only: str = "", blind: bool = False) -> _Step:
        """One step of a training on one frame.

        Args:
            only: leave out the other entity. blind: the frame has no masks and no depth.
        """
        scene = tiny_scene(*filter(None, [only]))
        frame = tiny_clip().frame(position)
        if blind:
            empty = {name: torch.zeros_like(mask) for name, mask in frame.masks.items()}
            frame = replace(frame, masks=empty, depth=None, unknown=frozenset(empty))
        return _Step(Weighted("term", self.objective(), 1.0), scene, frame)


class _Step:
    """What a trainer does with an objective in one step."""

    def __init__(self, weighted: Weighted, scene: SceneModel, frame: Any) -> None:
        self.weighted, self.scene, self.frame = weighted, scene, frame

    def losses(self) -> dict[str, Tensor]:
        generator = torch.Generator().manual_seed(0)
        state = self.scene(self.frame.moment)
        at = TrainingMoment(self.scene, self.frame, self.frame.camera, state, generator)
        channels = self.weighted.channels(at)
        drawn = self.scene.draw(state.joined(), at.camera, RenderRequest(features=channels))
        return self.weighted.terms(at, drawn, drawn.features)


CHECKS: CheckList[ObjectiveSubject] = CheckList("L")


def subject(cls: type[Objective], config: Any, options: Options) -> ObjectiveSubject:
    made = ObjectiveSubject(cls, config)
    made.objective()
    return made


def _steps(subject: ObjectiveSubject) -> Iterator[_Step]:
    return (subject.step(position) for position in (0, 4, 8))


@CHECKS.check("L01")
def it_gives_a_loss(subject: ObjectiveSubject) -> str:
    """Some frame has a loss; all losses are finite numbers, none below 0."""
    names = set()
    for step in _steps(subject):
        for name, value in step.losses().items():
            require_finite(name, value)
            require(float(value) >= 0, f"{name} is {float(value):.3g}, expected 0 or more")
            names.add(name)
    require(bool(names), "no frame has a loss")
    return ", ".join(sorted(names))


@CHECKS.check("L02")
def losses_are_differentiable(subject: ObjectiveSubject) -> None:
    """Some loss has a finite gradient at the scene's parameters."""
    largest = 0.0
    for step in _steps(subject):
        losses = step.losses()
        for name, value in losses.items():
            require(value.requires_grad, f"{name} has no gradient: it was detached")
        if losses:
            torch.stack(list(losses.values())).sum().backward()
        for name, parameter in step.scene.named_parameters():
            if parameter.grad is not None:
                require_finite(f"the gradient at {name}", parameter.grad)
                largest = max(largest, float(parameter.grad.abs().max()))
    require(largest > 0, "the gradient at every parameter is 0")


@CHECKS.check("L03")
def a_step_can_be_repeated(subject: ObjectiveSubject) -> None:
    """Two new instances, and one that is used again, give the same losses."""
    for position in (0, 4):
        step = subject.step(position)
        first, again, new = step.losses(), step.losses(), subject.step(position).losses()
        for other in (again, new):
            same = first.keys() == other.keys() and all(first[n] == other[n] for n in first)
            require(same, f"the losses of frame {position} differ: {first} and {other}")


@CHECKS.check("L04")
def inputs_are_not_modified(subject: ObjectiveSubject) -> None:
    """Neither the frame, nor the scene, nor torch's random state changes."""
    step = subject.step(4)

    def inputs() -> dict[str, Tensor]:
        found = {f"scene.{n}": x for n, x in step.scene.state_dict().items()}
        found |= {f"mask of {n}": x for n, x in step.frame.masks.items()}
        return found | {"image": step.frame.image, "torch's random state": torch.get_rng_state()}

    with unchanged("", inputs):
        step.losses()


@CHECKS.check("L05")
def frames_without_masks_are_allowed(subject: ObjectiveSubject) -> None:
    """A frame without masks and depth has finite losses, or none."""
    for name, value in subject.step(4, blind=True).losses().items():
        require_finite(name, value)


@CHECKS.check("L06")
def any_entity_may_be_absent(subject: ObjectiveSubject) -> None:
    """A scene of the human alone, or of the object alone, has finite losses, or none."""
    for only in (HUMAN, OBJECT):
        try:
            losses = subject.step(4, only=only).losses()
        except Exception as error:
            raise CheckError(f"with {only} alone: {error!r}") from error
        for name, value in losses.items():
            require_finite(f"with {only} alone: {name}", value)
