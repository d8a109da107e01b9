"""Capabilities of a spec: what a small model of it, composed for a tiny clip, consists of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

from hoigs.core.interfaces.density import DensityControl
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip

# Capabilities of a composed model: a case concerns models by these, not by the spec's name.

Capability = Literal[
    "scene", "body", "object", "whole picture", "moves", "density", "masks", "knots", "rigid knots",
    "free knots", "time planes", "networks", "keyed opacity",
]  # fmt: skip
MEANING: Mapping[Capability, str] = {
    "scene": "Gaussians of the background",
    "body": "a human on a skeleton",
    "object": "an object with Gaussians of its own",
    "whole picture": "people and objects modelled as part of the scene",
    "moves": "something whose Gaussians move",
    "density": "density control with a cap",
    "masks": "entities compared within their masks",
    "knots": "positions at keyframes",
    "rigid knots": "keyframes of one rigid motion of a whole entity",
    "free knots": "keyframes of each Gaussian",
    "time planes": "feature planes over space and time",
    "networks": "networks that deform",
    "keyed opacity": "opacity that depends on time",
}
assert set(MEANING) == set(get_args(Capability))


def capabilities(model: SceneModel, density: Mapping[str, DensityControl]) -> frozenset[Capability]:
    """Capabilities of a model composed for a clip with one human and one object."""
    return frozenset(_found(model, density))


def _found(model: SceneModel, density: Mapping[str, DensityControl]) -> Iterator[Capability]:
    names = {kind: model.names(kind) for kind in ("scene", "human", "object")}
    kinds: dict[str, Capability] = {"scene": "scene", "human": "body", "object": "object"}
    yield from (word for kind, word in kinds.items() if names[kind])
    if names["human"] or names["object"]:
        yield "masks"
    elif names["scene"]:
        yield "whole picture"
    if any(control.cap is not None for control in density.values()):
        yield "density"
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
        turns = rate == "keyframe_rotation" or (name in keyed and name.endswith("quats"))
        if not turns and (rate == "keyframes" or (name in keyed and rate == "pose")):
            yield "knots"
            free = parameter.dim() > 2 or name in deformation.per_gaussian
            yield "free knots" if free else "rigid knots"
        elif not turns and rate == "planes" and "time" in name:
            yield "time planes"
        elif not turns and rate == "networks":
            yield "networks"
        if name.endswith(("opacity_logits", "centers")) and parameter.dim() > 1:
            yield "keyed opacity"


def rate_of(name: str, rates: Mapping[str, str]) -> str:
    """Name of the learning rate of a deformation's parameter."""
    prefixes = [prefix for prefix in rates if name.startswith(prefix)]
    return rates[max(prefixes, key=len)] if prefixes else "networks"


# Settings that adapt a spec to a small clip and a short training.

# shares of all points, where a spec has such a block
SHARES = {"human": 0.3, "object": 0.1}
ROOM = 2.0  # cap of the scene's Gaussians, times those at the start
# settings of components that are counted in steps, by place
COUNTED = {
    "density": ("interval", "reset_every"),
    "deformation": ("promote_from", "promote_every", "promote_until"),
}


def small_settings(spec: Spec, points: int, steps: int) -> list[str]:
    """Overrides for a short training on a small clip; the same rules for all methods.

    All entities together start with `points` Gaussians, and the scene's cap is twice its own.
    Settings in steps are scaled with the length of the training. The LPIPS and face losses, which
    need files or larger images, are off.
    """
    settings = {
        "train.steps": steps,
        "train.preview_every": 0,
        "train.loss.lpips": 0.0,
        "train.loss.face": 0.0,
        "train.checkpoint_every": steps,
    }
    shrink = steps / spec.train.steps
    if spec.train.sh_interval is not None:
        settings["train.sh_interval"] = max(1, round(shrink * spec.train.sh_interval))
    blocks = dict(modelled(spec))
    scene = 1.0 - sum(SHARES[kind] for kind in blocks.values() if kind in SHARES)
    for name, kind in blocks.items():
        count = round(points * SHARES.get(kind, scene))
        settings[f"model.{name}.points"] = count
        block = spec.model[name]
        if "cap" in block.density.settings:
            settings[f"model.{name}.density.cap"] = round(ROOM * count)
        for part, keys in COUNTED.items():
            own: dict[str, Any] = getattr(block, part).settings
            for key in keys:
                if own.get(key) is not None:
                    least = 10 if key == "interval" else 1
                    settings[f"model.{name}.{part}.{key}"] = max(least, round(shrink * own[key]))
    return [f"{key}={value}" for key, value in settings.items()]


def modelled(spec: Spec) -> Iterator[tuple[str, str]]:
    """Name and kind of each model block that a clip with "human" and "object" makes use of."""
    for entity in ("scene", "human", "object"):
        block = spec.block(entity, entity)
        if block is not None and spec.selects(entity, entity):
            yield block[0], entity


TINY = (
    "builtin:figure-eight?frames=12&width=48&fps=6&samples=1&edge_samples=1&held_out_views=0"
    "&test_frames=3&scene_points=600&object_points=200"
)
POINTS, STEPS = 400, 12


def compose_small(
    source: str,
    overrides: Sequence[str] = (),
    plugins: Sequence[str] = (),
    clip: Clip | None = None,
) -> tuple[Spec, SceneModel, Mapping[str, DensityControl]]:
    """A spec, resolved and made small, with its model and density control on the tiny clip.

    Args:
        clip: in place of the tiny clip.

    Raises:
        SpecError: the spec is invalid, or does not fit a clip of one human and one object.
    """
    registry = default_registry([Path(p) for p in plugins])
    clip = clip or tiny_clip()
    own = Spec.load(source, overrides=list(overrides), registry=registry)
    settings = [*small_settings(own, POINTS, STEPS), *overrides, f"train.steps={STEPS}"]
    spec = Spec.load(source, overrides=settings, registry=registry)
    return spec, compose(spec, clip, registry), compose_density(spec, clip, registry)


@cache
def tiny_clip(more: str = "") -> Clip:
    """The tiny clip, with more settings of its generator."""
    from hoigs.runs.clip_source import read_clip

    return read_clip(f"{TINY}&{more}" if more else TINY)
