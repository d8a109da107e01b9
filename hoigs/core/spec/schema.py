"""Spec: a method as a file that names its components and their settings. It needs no torch.

A file is YAML or TOML. Each component is a block of `use: "kind:name"` beside that component's own
settings, which its own config class checks. `extends: NAME_OR_FILE` starts from another spec.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
)

from hoigs.core.errors import PluginError, SpecError, did_you_mean
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.errors import explain
from hoigs.core.spec.files import (
    BUILTIN_SPECS,
    extended,
    read_spec,
)
from hoigs.core.spec.loader import Document, Place, dump_yaml, load_overrides, load_yaml
from hoigs.core.spec.train_schema import EvaluationSpec, TrainSpec, rate_names
from hoigs.core.system.files import NAME, RULE

# Names that specs of version 0.1 used, read as the present ones.
#
# A run folder keeps the spec that it was trained with, so what `hoigs train` wrote before a rename
# must still open.

OLD, NEW = "prior", "initializer"  # of an entity's block, and the kind of its component


def with_present_names(document: Document) -> Document:
    """`document` with the keys that specs have today; positions in the file are kept."""
    model = document.data.get("model")
    blocks = model.items() if isinstance(model, dict) else ()
    old = {name for name, block in blocks if isinstance(block, dict) and OLD in block}
    if not old:
        return document

    def place(at: Place) -> Place:
        renamed = len(at) > 2 and at[0] == "model" and at[1] in old and at[2] == OLD
        return (*at[:2], NEW, *at[3:]) if renamed else at

    return replace(
        document,
        data=document.data | {"model": {name: _block(block) for name, block in blocks}},
        keys={place(at): where for at, where in document.keys.items()},
        values={place(at): where for at, where in document.values.items()},
    )


def _block(block: Any) -> Any:
    if not isinstance(block, dict) or OLD not in block:
        return block
    part = block[OLD]
    if isinstance(part, dict) and isinstance(part.get("use"), str):
        kind, _, name = part["use"].partition(":")
        part = part | {"use": f"{NEW if kind == OLD else kind}:{name}"}
    return {NEW if key == OLD else key: part if key == OLD else v for key, v in block.items()}


# sections that decide which tensors a model has; a checkpoint belongs to these
MODEL_SECTIONS = ("interaction", "decoder", "entities", "model")
# sections that older specs do not have: they enter a hash where they are not empty
LATER = ("objectives", "decoder")
# settings of an entity that decide no tensor's existence: how training changes the count, and where
# opacities start. `points` is not among them: penalties between neighbours depend on first points.
OF_AN_ENTITY = ("deformation", "features", "density", "body", "initializer")  # components
TRAINING_ONLY = ("density", "opacity", "thickness")


class _Strict(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False
    )


class ComponentSpec(BaseModel):
    """One component: `use`, and its settings beside it; a resolved spec has all of them."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    use: str
    """"kind:name", or "kind:name@distribution"."""

    @property
    def settings(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class ObjectiveSpec(ComponentSpec):
    """A term of the loss that a plugin brings, and its weight."""

    weight: float = Field(default=1.0, ge=0, allow_inf_nan=False)
    """Factor of every loss that it gives."""


class EntitySpec(_Strict):
    """How one entity, or every entity of a kind, is modelled."""

    deformation: ComponentSpec
    """The deformation: how it moves."""
    features: ComponentSpec | None = None
    """Its feature extractor: tokens for the interaction; None leaves it out of the interaction."""
    density: ComponentSpec = ComponentSpec(use="density:none")
    """Density control: when it gains and loses Gaussians."""
    body: ComponentSpec | None = None
    """Settings of a human's body model; by default those of the one that the clip names."""
    initializer: ComponentSpec | None = None
    """Where an object's first points and its track come from; None takes the clip's own."""
    sh_degree: Annotated[int, Field(ge=0, le=3)] | Literal["auto"] = 0
    """Spherical-harmonics degree of its colours. "auto", for a scene, is 2 where training
    cameras see it from several sides, and 0 where they stay in one place: colours that depend on
    the direction are then not determined, and look wrong from any other place."""
    points: int = Field(default=10_000, ge=1)
    """Gaussians at the start; scene and objects have fewer where the clip has fewer points for
    them."""
    upsample: bool = False
    """For objects: where the track has fewer points than `points`, more are put between them."""
    opacity: float = Field(default=0.1, gt=0, lt=1)
    """Opacity of every Gaussian at the start."""
    thickness: float = Field(default=1.0, gt=0, le=1)
    """Thickness of every Gaussian of a person or object at the start, along the surface's normal,
    as a share of its width; 1 is isotropic (3DGS). Flat ones stay sharp in views beside the
    filmed path."""


class Spec(_Strict):
    """A complete method."""

    name: str
    """For listings, reports and the folders of runs; letters, digits, `_`, `-` and `.`, with
    `@PROFILE` after it where a profile was taken."""
    summary: str = ""
    """For listings and reports."""
    rasterizer: ComponentSpec = ComponentSpec(use="rasterizer:warp")
    """Draws every image."""
    low_pass: float = Field(default=0.3, ge=0, le=4)
    """Variance added to every Gaussian's covariance on screen, square pixels, in training and
    whenever the model is drawn. 0.3 is that of 3DGS; the square of a pixel has 1/12, and with 0.1
    edges and patterns are sharper."""
    antialiased: bool = False
    """Lower the opacity of a Gaussian by what `low_pass` adds to its area (Mip-Splatting), so that
    pictures larger or smaller than those of the training look alike. False is 3DGS."""
    interaction: ComponentSpec = ComponentSpec(use="interaction:none")
    """Couples the entities."""
    decoder: ComponentSpec | None = None
    """Makes the picture from what was drawn; None takes the colours as they are drawn."""
    entities: tuple[str, ...] | None = None
    """Names or kinds of the clip's entities to model; None models all. The others are ignored:
    their pixels count as scene."""
    model: dict[str, EntitySpec]
    """By exact entity name or by kind (scene, human, object); the name wins. Blocks that the clip
    has no entity for are not used."""
    objectives: dict[str, ObjectiveSpec] = Field(default_factory=dict)
    """Terms of the loss that plugins bring, by names of your choice."""
    train: TrainSpec = TrainSpec()
    """How the model is optimised."""
    evaluation: EvaluationSpec = EvaluationSpec()
    """How a run is scored."""

    _document: Document = PrivateAttr(default_factory=lambda: Document("spec"))

    @field_validator("name")
    @classmethod
    def _name_is_safe(cls, name: str) -> str:
        base, at, profile = name.partition("@")
        if not all(NAME.fullmatch(part) for part in ([base, profile] if at else [base])):
            raise ValueError(RULE)
        return name

    @staticmethod
    def load(
        source: str | Path,
        *,
        overrides: Sequence[str] = (),
        registry: Registry | None = None,
    ) -> Spec:
        """Read, check and resolve a spec.

        Args:
            source: a built-in spec's name, or a .yaml, .yml or .toml file; "@PROFILE" after it
                selects one of its profiles ("4dgs@matched").
            overrides: "a.b=value", laid over the file.
            registry: where components are looked up; by default what is installed.

        Raises:
            SpecError: everything that is wrong, a line each, with its position.
        """
        document = read_spec(source)
        if overrides:
            document = document.merged(load_overrides(list(overrides)))
        return _resolve(document, registry or default_registry())

    @staticmethod
    def parse(text: str, *, source: str = "spec", registry: Registry | None = None) -> Spec:
        """A spec from YAML text; `extends` may name built-in specs only.

        Raises:
            SpecError: as `load`.
        """
        document = extended(load_yaml(text, source))
        return _resolve(document, registry or default_registry())

    def block(self, name: str, kind: str) -> tuple[str, EntitySpec] | None:
        """The model block for an entity, and its key."""
        for key in (name, kind):
            if key in self.model:
                return key, self.model[key]
        return None

    def selects(self, name: str, kind: str) -> bool:
        """Whether an entity of the clip is to be modelled."""
        return self.entities is None or name in self.entities or kind in self.entities

    def component_specs(self) -> Iterator[tuple[Place, ComponentSpec]]:
        """Every component with its place in the tree."""
        yield ("rasterizer",), self.rasterizer
        yield ("interaction",), self.interaction
        if self.decoder is not None:
            yield ("decoder",), self.decoder
        for name, block in self.model.items():
            for field in OF_AN_ENTITY:
                part = getattr(block, field)
                if part is not None:
                    yield ("model", name, field), part
        for name, term in self.objectives.items():
            yield ("objectives", name), term

    def components(self) -> dict[str, str]:
        """The key of every component by its dotted place."""
        return {".".join(map(str, place)): part.use for place, part in self.component_specs()}

    def at(self, *place: str) -> str:
        """`file:line:column dotted.place`, for messages about a part of this spec."""
        return f"{self._document.where(place)} {'.'.join(place)}"

    def dump(self) -> str:
        """Canonical YAML, every default filled in; it is itself a spec and equal to this one."""
        return dump_yaml(self.model_dump(mode="json"))

    def hash(self) -> str:
        """SHA-256 of what a result depends on: not names and summary, nor how it is computed."""
        left_out = {"name", "summary"}
        sections = [f for f in type(self).model_fields if f not in left_out]
        return self._digest(sections, {"train": {"graphs"}})

    def model_hash(self) -> str:
        """SHA-256 of what decides which tensors the model has; checkpoints carry it.

        Density control and first opacities are left out, as a run may continue with another cap.
        """
        without = {"model": {name: set(TRAINING_ONLY) for name in self.model}}
        return self._digest(MODEL_SECTIONS, without)

    def model_hashes(self) -> tuple[str, ...]:
        """Hashes of checkpoints that belong to this spec, `model_hash` first. The other is of the
        settings that are written in its file: an older hoigs, which had fewer, took it of these,
        and settings that came later do by default what it did."""
        written = {key: self._document.data.get(key) for key in self._present(MODEL_SECTIONS)}
        blocks = written["model"] if isinstance(written["model"], dict) else {}
        written["model"] = {
            name: {key: value for key, value in block.items() if key not in TRAINING_ONLY}
            for name, block in blocks.items()
            if isinstance(block, dict)
        }
        return self.model_hash(), _sha256(written)

    def _present(self, sections: Sequence[str]) -> set[str]:
        return {key for key in sections if key not in LATER or getattr(self, key)}

    def _digest(self, sections: Sequence[str], without: dict[str, Any] | None = None) -> str:
        include = self._present(sections)
        return _sha256(self.model_dump(mode="json", include=include, exclude=without))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Spec) and self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash((self.name, self.hash()))


def _sha256(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()


def _resolve(document: Document, registry: Registry) -> Spec:
    """Check the tree, then each component's settings with its own config class."""
    document = with_present_names(document)
    try:
        spec = Spec.model_validate(document.data)
    except ValidationError as error:
        lines = explain(error, Spec, document, ())
        for place, part in _written_components(document.data):  # their mistakes at once, too
            lines += _settings(part, place, document, registry)[1]
        raise SpecError("\n".join(lines)) from error
    problems: list[str] = []
    data = spec.model_dump()
    for place, part in spec.component_specs():
        settings, trouble = _settings(part, place, document, registry)
        problems += trouble
        node: Any = data
        for step in place[:-1]:
            node = node[step]
        weight = {"weight": part.weight} if isinstance(part, ObjectiveSpec) else {}
        node[place[-1]] = {"use": part.use, **weight, **settings}
    if problems:
        raise SpecError("\n".join(problems))
    resolved = Spec.model_validate(data)
    resolved._document = document
    return resolved


def _written_components(data: dict[str, Any]) -> Iterator[tuple[Place, ComponentSpec]]:
    """The components of a tree that is no spec as a whole, where each stands."""
    places: list[Place] = [("rasterizer",), ("interaction",), ("decoder",)]
    model = data.get("model")
    for name in model if isinstance(model, dict) else ():
        places += [("model", name, field) for field in OF_AN_ENTITY]
    objectives = data.get("objectives")
    places += [("objectives", n) for n in (objectives if isinstance(objectives, dict) else ())]
    for place in places:
        block: Any = data
        for step in place:
            block = block.get(step) if isinstance(block, dict) else None
        if isinstance(block, dict) and isinstance(block.get("use"), str):
            own = {k: v for k, v in block.items() if k != "weight" or place[0] != "objectives"}
            yield place, ComponentSpec.model_validate(own)


def _settings(
    part: ComponentSpec, place: Place, document: Document, registry: Registry
) -> tuple[dict[str, Any], list[str]]:
    """Complete settings of one component, and what is wrong with it."""
    path = ".".join(map(str, place))
    use, kind = (*place, "use"), str(place[-1])
    if place[0] == "objectives":
        kind = "objective"
    try:
        found = registry.component(part.use)
        if found.kind != kind:
            known = ", ".join(registry.keys(kind))
            return {}, [
                f'{document.where(use)} {path}.use: "{part.use}" is no {kind} (known: {known})'
            ]
        config_class = registry.config_class(part.use)
        registry.get(part.use)
    except PluginError as error:
        known = "" if ":" in part.use else f" (known: {', '.join(registry.keys(kind))})"
        return {}, [f"{document.where(use)} {path}.use: {error}{known}"]
    try:
        return config_class.model_validate(part.settings).model_dump(mode="json"), []
    except ValidationError as error:
        return {}, explain(error, config_class, document, place)


# Components of one block that do not fit each other, by what their classes declare.

KINDS = ("scene", "human", "object")  # blocks of other names are of one entity, of any kind


def require_fitting(spec: Spec, registry: Registry) -> None:
    """Refuse a deformation of other kinds of entity, features that require what it lacks or give
    other tokens than the interaction needs, and rates that `train.rates` does not have.

    `compose` refuses these, too; here no clip is needed. A spec is not checked when it is loaded: a
    search changes one component after the other.

    Raises:
        SpecError: a line for each, with its position.
    """
    from hoigs.core.interfaces.features import check_provided
    from hoigs.core.interfaces.interaction import check_tokens

    found = _unknown_rates(spec, registry)
    interaction = registry.get(spec.interaction.use)
    name: Any  # an EntityKind, where it is one
    for name, block in spec.model.items():
        deformation = registry.get(block.deformation.use)
        if name in KINDS and name not in deformation.kinds:
            found.append(
                f"{spec.at('model', name, 'deformation', 'use')}: {deformation.__name__} deforms "
                f"entities of kind {' or '.join(sorted(deformation.kinds))}, not {name}"
            )
        elif block.features is not None:
            features = registry.get(block.features.use)
            try:
                check_provided(features, deformation)
                if name in KINDS:
                    check_tokens(interaction, features, name)
            except ValueError as error:
                parts = ("deformation", "features")  # of these, the one that a user wrote
                places = [spec.at("model", name, part, "use") for part in parts]
                place = min(places, key=lambda at: at.startswith(str(BUILTIN_SPECS)))
                found.append(f"{place}: {error}")
    if found:
        raise SpecError("\n".join(found))


def _unknown_rates(spec: Spec, registry: Registry) -> list[str]:
    """A line for each learning rate that a component declares and `train.rates` lacks."""
    found, known = [], rate_names()
    for place, part in spec.component_specs():
        declared: Any = getattr(registry.get(part.use), "rates", {})
        for prefix, rate in declared.items():
            if rate not in known:
                found.append(
                    f'{spec.at(*map(str, place), "use")}: {part.use} declares rates["{prefix}"] as '
                    f'"{rate}"{did_you_mean(rate, known)}; train.rates has {", ".join(known)}'
                )
    return found
