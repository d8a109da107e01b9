"""Capabilities of a composed model: a case concerns models by these, not by the spec's name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    from hoigs.core.interfaces.density import DensityControl
    from hoigs.core.model.entity import Entity
    from hoigs.core.model.scene import SceneModel
    from hoigs.core.spec.schema import Spec

Capability = Literal[
    "scene", "body", "object", "whole picture", "moves", "interaction", "density", "depth loss",
    "masks", "knots", "turning knots", "rigid knots", "free knots", "time planes", "planes",
    "networks", "embedding", "keyed opacity", "refined poses", "keyframe rate",
]  # fmt: skip

MEANING: Mapping[Capability, str] = {
    "scene": "Gaussians of the background",
    "body": "a human on a skeleton",
    "object": "an object with Gaussians of its own",
    "whole picture": "people and objects modelled as part of the scene",
    "moves": "something whose Gaussians move",
    "interaction": "a module between human and object",
    "density": "density control with a cap",
    "depth loss": "a depth prior in the loss",
    "masks": "entities compared within their masks",
    "knots": "positions at keyframes",
    "turning knots": "rotations at keyframes",
    "rigid knots": "keyframes of one rigid motion of a whole entity",
    "free knots": "keyframes of each Gaussian",
    "time planes": "feature planes over space and time",
    "planes": "feature planes",
    "networks": "networks that deform",
    "embedding": "a code for each Gaussian",
    "keyed opacity": "opacity that depends on time",
    "refined poses": "body poses that training corrects",
    "keyframe rate": "keyframes with a learning rate of their own",
}
assert set(MEANING) == set(get_args(Capability))


def capabilities(
    spec: Spec, model: SceneModel, density: Mapping[str, DensityControl]
) -> frozenset[Capability]:
    """Capabilities of a model composed for a clip with one human and one object."""
    return frozenset(_found(spec, model, density))


def _found(
    spec: Spec, model: SceneModel, density: Mapping[str, DensityControl]
) -> Iterator[Capability]:
    from hoigs.training.losses.terms import term_weights

    names = {kind: model.names(kind) for kind in ("scene", "human", "object")}
    if names["scene"]:
        yield "scene"
    if names["human"]:
        yield "body"
    if names["object"]:
        yield "object"
    if names["scene"] and not names["human"] and not names["object"]:
        yield "whole picture"
    if names["human"] or names["object"]:
        yield "masks"
    if model.interaction is not None and any(True for _ in model.interaction.parameters()):
        yield "interaction"
    if any(control.cap is not None for control in density.values()):
        yield "density"
    if term_weights(spec.train.loss)["depth"] > 0:
        yield "depth loss"
    for name in model.entities:
        yield from _of_entity(model.entity(name))


def _of_entity(entity: Entity) -> Iterator[Capability]:
    """Capabilities by the learning rates of the deformation's parameters."""
    deformation = entity.deformation
    parameters = dict(deformation.named_parameters())
    if parameters or entity.kind != "scene":
        yield "moves"
    keyed = getattr(deformation, "knot_axes", {})
    for name, parameter in parameters.items():
        rate = rate_of(name, deformation.rates)
        if rate == "keyframes":
            yield "keyframe rate"
        turns = rate == "keyframe_rotation" or (name in keyed and name.endswith("quats"))
        if turns:
            yield "turning knots"
        elif rate == "keyframes" or (name in keyed and rate == "pose"):
            yield "knots"
            free = parameter.dim() > 2 or name in deformation.per_gaussian
            yield "free knots" if free else "rigid knots"
        elif rate == "planes":
            yield "planes"
            if "time" in name:
                yield "time planes"
        elif rate == "networks":
            yield "networks"
        elif rate == "embedding":
            yield "embedding"
        elif rate == "pose" and entity.kind == "human":
            yield "refined poses"
        if name.endswith(("opacity_logits", "centers")) and parameter.dim() > 1:
            yield "keyed opacity"


def rate_of(name: str, rates: Mapping[str, str]) -> str:
    """Name of the learning rate of a deformation's parameter."""
    prefixes = [prefix for prefix in rates if name.startswith(prefix)]
    return rates[max(prefixes, key=len)] if prefixes else "networks"
