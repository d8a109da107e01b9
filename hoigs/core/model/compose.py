"""compose: from a spec and a clip to a SceneModel and its density controls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import ClipError, HoigsError, PluginError, SpecError, did_you_mean
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.density import DensityControl, check_rasterizer
from hoigs.core.interfaces.initializer import ObjectInitializer, check_track
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.maths.nearest import denser
from hoigs.core.model.entity import Entity
from hoigs.core.model.objective import Weighted
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.schema import ComponentSpec, EntitySpec, Spec
from hoigs.core.system.files import require_entity_name
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.tokens import EntityKind

SCENE = "scene"
STILL = 0.02  # of the scene's extent: cameras that move less see each point from one side


def compose(spec: Spec, clip: Clip, registry: Registry | None = None) -> SceneModel:
    """The model that `spec` describes, initialised from `clip`, on the CPU.

    The same spec and clip give the same parameters; torch's global random state does not change.

    Raises:
        SpecError: an entity has no block, or a component cannot be built; with the spec's line.
        PluginError: a component that cannot be loaded.
    """
    builder = _Builder(spec, clip, registry or default_registry())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(spec.train.seed)
        context = BuildContext(clip=clip, seed=spec.train.seed)
        rasterizer = builder.part(("rasterizer",), spec.rasterizer, context)
        bodies = builder.bodies()
        entities = {
            name: builder.entity(name, kind, place, block, rasterizer, bodies)
            for name, kind, place, block in builder.chosen()
        }
        interaction = builder.part(("interaction",), spec.interaction, context)
        decoder = None
        if spec.decoder is not None:
            decoder = builder.part(("decoder",), spec.decoder, context)
        with _errors_at(spec, "interaction"):
            model = SceneModel(
                entities,
                interaction=interaction,
                rasterizer=rasterizer,
                decoder=decoder,
                low_pass=spec.low_pass,
                antialiased=spec.antialiased,
            )
        _try_interaction(model, spec, clip)
        return model


def _try_interaction(model: SceneModel, spec: Spec, clip: Clip) -> None:
    """Raise SpecError where it refuses the entities' tokens: now, not when its warm-up is over."""
    try:
        with torch.no_grad():
            model.eval()(clip.moments[0], only=())
    except ValueError as error:
        raise SpecError(f"{spec.at('interaction')}: {error}") from error
    model.train()


def compose_bodies(
    spec: Spec, clip: Clip, registry: Registry | None = None
) -> dict[str, BodyModel]:
    """The body model of each human that `compose` builds, by name.

    Raises:
        SpecError, PluginError: as `compose`.
    """
    return _Builder(spec, clip, registry or default_registry()).bodies()


def compose_density(
    spec: Spec, clip: Clip, registry: Registry | None = None
) -> dict[str, DensityControl]:
    """The density control of each entity that `compose` builds, by name.

    Raises:
        SpecError, PluginError: as `compose`.
    """
    builder = _Builder(spec, clip, registry or default_registry())
    controls = {}
    for name, _, place, block in builder.chosen():
        where = ("model", place, "density")
        context = BuildContext(entity=name, clip=clip, seed=spec.train.seed)
        controls[name] = builder.part(where, block.density, context)
        with _errors_at(spec, *where):
            check_rasterizer(controls[name], builder.registry.get(spec.rasterizer.use))
    return controls


def compose_objectives(
    spec: Spec, clip: Clip, registry: Registry | None = None
) -> tuple[Weighted, ...]:
    """The further terms of the loss that `spec` names; those of weight 0 are left out.

    Raises:
        SpecError, PluginError: as `compose`.
    """
    builder = _Builder(spec, clip, registry or default_registry())
    context = BuildContext(clip=clip, seed=spec.train.seed)
    return tuple(
        Weighted(name, builder.part(("objectives", name), part, context), part.weight)
        for name, part in spec.objectives.items()
        if part.weight > 0
    )


@dataclass(frozen=True)
class _Builder:
    """Builds the components of one spec and clip."""

    spec: Spec
    clip: Clip
    registry: Registry

    def chosen(self) -> list[tuple[str, EntityKind, str, EntitySpec]]:
        """Every entity to be modelled: its name, its kind, its block's key and its block."""
        kinds: dict[str, EntityKind] = {SCENE: "scene", **self.clip.kinds}
        dynamic = [name for name in self.spec.model if name != SCENE]
        if not self.clip.kinds and self.spec.entities is None and dynamic:
            raise SpecError(
                f"{self.spec.at('model')}: {self.spec.name} models {' and '.join(dynamic)}, and "
                f"clip {self.clip.name} has no entity but the scene; take a spec for the whole "
                "picture (--spec 4dgs, d3dgs), or model the scene alone (--set entities=[scene])"
            )
        found = []
        for name, kind in kinds.items():
            try:
                require_entity_name(name)
            except ValueError as error:
                raise ClipError(f"clip {self.clip.name}: {error}") from error
            if not self.spec.selects(name, kind):
                continue
            block = self.spec.block(name, kind)
            if block is None:
                raise SpecError(
                    f"{self.spec.at('model')}: no block for the clip's {kind} "
                    f'"{name}"{did_you_mean(name, self.spec.model)}; add model.{kind}, or leave '
                    "it out with `entities`"
                )
            found.append((name, kind, *block))
        if not found:
            raise SpecError(
                f"{self.spec.at('entities')}: none of {', '.join(self.spec.entities or ())} is in "
                f"the clip, which has {', '.join(f'{n} ({k})' for n, k in kinds.items())}"
            )
        return found

    def part(self, place: tuple[str, ...], part: ComponentSpec, context: BuildContext) -> Any:
        """One component, built from its settings."""
        config = self.registry.config_class(part.use).model_validate(part.settings)
        component = self.registry.concrete(part.use)
        with _errors_at(self.spec, *place) if place else nullcontext():
            return component.from_config(config, context)

    def entity(
        self,
        name: str,
        kind: EntityKind,
        place: str,
        block: EntitySpec,
        rasterizer: Rasterizer,
        bodies: Mapping[str, BodyModel],
    ) -> Entity:
        context = BuildContext(entity=name, clip=self.clip, seed=self.spec.train.seed)
        if kind == "human":
            context = replace(context, body_track=self.clip.bodies[name], body=bodies[name])
        elif kind == "object":
            track = self.clip.objects.get(name)
            context = replace(context, object_track=track, bodies=bodies)
        if kind == "object" and context.object_track is None and block.initializer is None:
            raise SpecError(
                f"{self.spec.at('model', place)}: the clip has no track of {name}; give an "
                "`initializer`"
            )
        if block.initializer is not None:
            context = self._with_initializer(context, kind, place, block.initializer, rasterizer)
        deformation = self.part(("model", place, "deformation"), block.deformation, context)
        features = None
        if block.features is not None:
            features = self.part(("model", place, "features"), block.features, context)
        with _errors_at(self.spec, "model", place):
            canonical = initial_gaussians(kind, deformation, block, context)
            return Entity(canonical, deformation, features, kind=kind)

    def bodies(self) -> dict[str, BodyModel]:
        """The body model of every human, by entity."""
        return {
            name: self._body(name, place, block)
            for name, kind, place, block in self.chosen()
            if kind == "human"
        }

    def _body(self, name: str, place: str, block: EntitySpec) -> BodyModel:
        """The body model that the clip's poses of a human were fitted with."""
        track = self.clip.bodies.get(name)
        if track is None:
            why = self.clip.provenance.get(f"poses of {name}", "its reader gives none")
            raise SpecError(
                f"{self.spec.at('model', place)}: clip {self.clip.name} has no body poses of "
                f"{name}: {why}; or take a spec for the whole picture (--spec 4dgs, d3dgs)"
            )
        context = BuildContext(
            entity=name, clip=self.clip, seed=self.spec.train.seed, body_track=track
        )
        if block.body is None:
            why = f"the clip's {name} is a {track.model}: "
            with _errors_at(self.spec, "model", place, why=why):
                body: BodyModel = self.part((), self._default_body(track.model), context)
                return body
        if block.body.use.partition("@")[0] != track.model.partition("@")[0]:
            raise SpecError(
                f"{self.spec.at('model', place, 'body')}: the clip's {name} was fitted with "
                f"{track.model}; its shape coefficients do not fit {block.body.use}"
            )
        body = self.part(("model", place, "body"), block.body, context)
        return body

    def _with_initializer(
        self,
        context: BuildContext,
        kind: EntityKind,
        place: str,
        part: ComponentSpec,
        rasterizer: Rasterizer,
    ) -> BuildContext:
        """`context` with the track that an initializer makes, in place of the clip's."""
        where, name = ("model", place, "initializer"), context.entity
        if kind != "object":
            raise SpecError(
                f"{self.spec.at(*where)}: initializers make objects; {name} is a {kind}"
            )
        initializer = self.part(where, part, replace(context, rasterizer=rasterizer))
        assert isinstance(initializer, ObjectInitializer)
        with _errors_at(self.spec, *where, why=f"{name}: "):
            track = check_track(initializer.initialize(self.clip, name), len(self.clip))
        return replace(context, object_track=track)

    def _default_body(self, key: str) -> ComponentSpec:
        """The body with default settings; PluginError if it has required ones."""
        fields = self.registry.config_class(key).model_fields.items()
        needed = [name for name, field in fields if field.is_required()]
        if needed:
            example = ", ".join(f"{name}: …" for name in needed)
            raise PluginError(f'add `body: {{use: "{key}", {example}}}` to this block')
        return ComponentSpec(use=key)


def initial_gaussians(
    kind: EntityKind, deformation: DeformationModel, block: EntitySpec, context: BuildContext
) -> Gaussians:
    """Canonical Gaussians of an entity, in the space that its deformation expects.

    The scene starts from the clip's points; a human from points spread evenly over its body; an
    object from the points of its track (the clip's, or its initializer's). Scales follow the
    spacing of the points (3DGS's rule).

    Raises:
        ValueError: the clip has no points, or a setting belongs to another kind.
    """
    clip = context.clip
    assert clip is not None
    degree = sh_degree_for(clip) if block.sh_degree == "auto" else block.sh_degree
    appearance: dict[str, Any] = {"opacity": block.opacity, "sh_degree": degree}
    if block.upsample and kind != "object":
        raise ValueError("upsample belongs to objects; remove it here")
    if kind != "scene":
        appearance["thickness"] = block.thickness
    if kind == "human":
        return _human(context, deformation, block.points, appearance)
    if kind == "object":
        return _object(context, deformation, block, appearance)
    if len(clip.points) == 0:
        raise ValueError("the clip has no scene points to start from (points.npz is empty)")
    if block.thickness != 1.0:
        raise ValueError("thickness belongs to surfaces, of people and objects; remove it here")
    rows = _subset(len(clip.points), block.points, context.seed)
    return Gaussians.from_points(clip.points[rows], clip.point_colors[rows], **appearance)


def sh_degree_for(clip: Clip) -> int:
    """The degree "auto": 2, but 0 where the training cameras stay in one place, seen from which no
    point shows another side of itself."""
    places = torch.stack([clip.cameras[i].center for i in clip.split["train"]])
    moved = float((places - places.mean(0)).norm(dim=-1).max())
    return 0 if moved < STILL * clip.extent() else 2


def _human(
    context: BuildContext, deformation: DeformationModel, count: int, appearance: dict[str, Any]
) -> Gaussians:
    body, track = context.body, context.body_track
    assert body is not None and track is not None
    betas = track.poses.betas
    betas = betas if betas.dim() == 1 else betas.mean(0)
    surface = body.surface(count, betas, context.seed)
    points = surface.points
    normals: Tensor | None = surface.normals
    if deformation.input_space == "world":
        pose = track.poses.frame(len(track.poses.transl) // 2)
        corners = body(pose).vertices[body.faces[surface.faces]]
        points = (corners * surface.barycentric[..., None]).sum(1)
        normals = None
    spacing = surface.spacing.detach()
    return Gaussians.from_points(points.detach(), scales=spacing, normals=normals, **appearance)


def _object(
    context: BuildContext,
    deformation: DeformationModel,
    block: EntitySpec,
    appearance: dict[str, Any],
) -> Gaussians:
    track = context.object_track
    assert track is not None
    rows = _subset(len(track.points), block.points, context.seed)
    points, colors = track.points[rows], track.colors[rows]
    if block.upsample:
        points, colors = denser(points, colors, block.points, context.seed)
    if deformation.input_space == "world":
        first = int(track.observed.nonzero()[0]) if track.observed.any() else 0
        points = points @ track.rotations[first].mT + track.translations[first]
    return Gaussians.from_points(points, colors, **appearance)


def _subset(available: int, count: int, seed: int) -> Tensor:
    """`count` random rows in ascending order, or all rows if there are fewer."""
    if available <= count:
        return torch.arange(available)
    generator = torch.Generator().manual_seed(seed)
    return torch.randperm(available, generator=generator)[:count].sort().values


@contextmanager
def _errors_at(spec: Spec, *place: str, why: str = "") -> Iterator[None]:
    """Errors raised inside become SpecErrors that name the component's place in the spec."""
    try:
        yield
    except SpecError:
        raise
    except (HoigsError, ValueError) as error:
        raise SpecError(f"{spec.at(*place)}: {why}{error}") from error
