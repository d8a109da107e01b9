"""DeformationModel: canonical Gaussians and a moment in, Gaussians at that moment out."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Protocol, TypeGuard, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.maths.splines import Knots
from hoigs.core.parameters import TimeRows
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import EntityKind, Residual
from hoigs.core.values.topology import AxisChange, TopologyChange, reindex


@dataclass(frozen=True)
class StepStatistics:
    """What one training step showed of one entity, for deformations that change their own size.

    Attributes:
        moment, camera: those of the frame drawn, on the model's device.
        error: image loss of the frame: the entity's own term, or the scene's if it has none, or 0.
            On the model's device: a number of it would have to wait for the device.
        screen_gradient: d loss / d projected means, per pixel, or None.
        radii: on the screen, pixels; 0 where a Gaussian was not drawn.
        step, total_steps: the number of this step, from 1, and of all steps.
    """

    moment: Moment
    camera: Camera
    error: Float[Tensor, ""]
    screen_gradient: Float[Tensor, "N 2"] | None
    radii: Float[Tensor, " N"]
    step: int
    total_steps: int


class DeformationModel(Configurable, nn.Module, ABC):
    """How one entity moves: canonical Gaussians and a moment to Gaussians at that moment.

    All Gaussians are raw (log-scales, opacity logits, quaternions wxyz of any length). The Entity
    calls `bind` once, then `forward` at every step; after a step training calls `evolve`, then
    `axis_changes` and `on_topology` if density control changes the number of Gaussians.

    Attributes:
        kinds: kinds of entities that it can move. Specs are checked by what a class declares here
            and in `provides`.
        provides: capabilities that feature extractors may require: "velocity" (ProvidesVelocity),
            "field" (ProvidesField), "skeleton" (ProvidesSkeleton), "face" (ProvidesFace).
        owns: fields of Gaussians that this model computes from parameters of its own; the entity
            does not train their canonical values.
        per_gaussian: names of this module's parameters whose first axis is the Gaussian.
        rates: parameter-name prefix to learning rate (a key of the spec's `train.rates`, for
            example "planes" or "keyframes"); other parameters take "networks".
        regularizer_weights: default weight of each penalty of `regularizers`; 0 where absent.
        residuals: parts of a Residual that it applies, of "means" and "pose". It ignores the
            others or refuses them with an error.
        moves: False if the output equals the canonical Gaussians at every moment, residual aside.
        continuous: whether the output is continuous in time.
        cut_gradients: fields of the canonical Gaussians, and prefixes of parameter names, whose
            gradient is detached somewhere on purpose, so that it is not the full derivative.
        input_space: space of the canonical Gaussians: "canonical" (a body in its zero pose, an
            object about its centre) where the model knows the body or the track that places them,
            else "world". May be set on the instance.
        time_rows: parameters of this module that have rows for times of the clip (TimeRows); those
            of modules in it are declared there.
        cuda_graph_safe: whether a CUDA graph may capture it; the conditions are in
            `hoigs.core.fast.graphs`.
        progress: done share of the training run, in [0, 1]; see `set_progress`.
        transient: attributes that hold results of a pass (a cache, outputs kept for
            `regularizers`) to the values they have in a copy or a pickle of the model: torch
            copies no tensor that has a graph. Those of base classes are included.
    """

    kinds: frozenset[EntityKind] = frozenset({"scene", "human", "object"})
    provides: frozenset[str] = frozenset()
    owns: frozenset[str] = frozenset()
    per_gaussian: tuple[str, ...] = ()
    rates: ClassVar[Mapping[str, str]] = {}
    regularizer_weights: ClassVar[Mapping[str, float]] = {}
    residuals: frozenset[str] = frozenset({"means"})
    moves: bool = True
    continuous: bool = True
    cut_gradients: frozenset[str] = frozenset()
    time_rows: Mapping[str, TimeRows] = MappingProxyType({})
    input_space: Literal["canonical", "world"] = "canonical"
    cuda_graph_safe: bool = False
    progress: float = 1.0
    transient: ClassVar[Mapping[str, Any]] = MappingProxyType({})

    def __getstate__(self) -> dict[str, Any]:
        state = dict(self.__dict__)
        for base in reversed(type(self).__mro__):
            for name, value in vars(base).get("transient", {}).items():
                state[name] = copy.copy(value)
        return state

    def bind(self, canonical: Gaussians) -> None:
        """Allocate what depends on the number of Gaussians. Called once, by the Entity."""
        del canonical

    @abstractmethod
    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        """The entity at `moment`: N raw Gaussians, world coordinates, metres.

        Args:
            canonical: N raw Gaussians in `input_space`.
            moment: the time in [0, 1], and the body pose of this entity if it has one.
            residual: correction by the interaction module, or None.
        """

    def means_at(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """The means of `forward` without a residual, metres, world; called by feature extractors.

        Override it where the means alone are cheaper.
        """
        means: Tensor = self(canonical, moment).means
        return means

    def hold(self, canonical: Gaussians, moment: Moment) -> None:
        """Compute once what depends on neither time nor pose. Called by Playback, in eval mode.

        Until `train()` or `eval()` is called the parameters stay, and body shapes
        (`BodyPose.betas`) are those of `moment`.
        """
        del canonical, moment

    def set_progress(self, progress: float) -> None:
        """Receive the done share of the run. Called before each step, and with 1 after the last."""
        self.progress = progress

    def peak_opacity_logits(self, canonical: Gaussians) -> Float[Tensor, " N"]:
        """The largest opacity logit of each Gaussian over time. Called by density control.

        The default is the canonical one; override it where opacity changes with time.
        """
        return canonical.opacity_logits

    def on_topology(self, change: TopologyChange) -> None:
        """Follow a change of the number of Gaussians; the default reindexes `per_gaussian`."""
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)

    def axis_changes(self, change: TopologyChange) -> Mapping[str, AxisChange]:
        """How parameters with rows for only some Gaussians will follow `change`, by name.

        Called before `on_topology`, so that the optimizer's moments can follow.
        """
        del change
        return {}

    def evolve(self, canonical: Gaussians, statistics: StepStatistics) -> Mapping[str, AxisChange]:
        """Change the model's own size: insert knots, promote Gaussians.

        Called after every optimizer step, before density control, without gradients. An override
        writes the new values to `parameter.data`, sets `grad` to None, keeps the Parameter objects,
        and returns by parameter name how the optimizer's moments follow.

        State from step to step belongs in persistent buffers, and decisions must not be random, so
        that a resumed run equals an unbroken one.
        """
        del canonical, statistics
        return {}

    def regularizers(self) -> dict[str, Tensor]:
        """Scalar penalties of the current parameters by name, unweighted. Called every step."""
        return {}


@runtime_checkable
class ProvidesVelocity(Protocol):
    """Deformations with "velocity" in `provides`."""

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """Time derivative of the means, metres per keyframe interval or per unit time."""
        ...


@runtime_checkable
class ProvidesField(Protocol):
    """Deformations with "field" in `provides`: a space-time feature field phi(x, y, z, t)."""

    field_width: int

    def posed_field(
        self, canonical: Gaussians, moment: Moment
    ) -> tuple[Float[Tensor, "V D"], Float[Tensor, "V 3"]]:
        """Features of V points of the body at `moment`, and their world positions, metres."""
        ...

    def field_parts(self) -> Tensor:
        """Body part (index of `interfaces.body.PART_NAMES`) of each of these points, int64 [V]."""
        ...


@runtime_checkable
class ProvidesSkeleton(Protocol):
    """Deformations with "skeleton" in `provides`: a posed body."""

    entity: str

    def point_parts(self) -> Tensor:
        """Body part (index of `interfaces.body.PART_NAMES`) of each Gaussian, int64 [N]."""
        ...

    def pose(self, moment: Moment) -> BodyPose:
        """The pose used at `moment`, refinements included."""
        ...

    def anchors(self, moment: Moment) -> Float[Tensor, "A 3"]:
        """World positions, metres: pelvis, left wrist, right wrist, left foot, right foot."""
        ...

    def arm_length(self) -> Float[Tensor, ""]:
        """Shoulder to middle fingertip, metres in the world (learnable body scale included)."""
        ...


@runtime_checkable
class ProvidesFace(Protocol):
    """Deformations with "face" in `provides`: a body that has a face."""

    def face_points(self) -> tuple[Tensor, Float[Tensor, "F 3"]]:
        """Rows of the Gaussians on the face, int64 [F], and their outward unit normals."""
        ...


@dataclass(frozen=True)
class Template:
    """The Gaussians of a body on the surface of its template, in its zero pose.

    Attributes:
        gaussians: raw, as they are drawn but for the pose.
        points: surface points, one a Gaussian, metres. normals: outward unit normals there.
        mirrored: `points` reflected in the body's plane of symmetry.
        parts: body part of each point (`hoigs.core.interfaces.body`).
        weights: of the body's joints, by which each Gaussian is posed; None if it is not.
    """

    gaussians: Gaussians
    points: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]
    mirrored: Float[Tensor, "N 3"]
    parts: Int[Tensor, " N"]
    weights: Float[Tensor, "N J"] | None = None


@runtime_checkable
class ProvidesTemplate(Protocol):
    """Deformations whose Gaussians belong to points of a symmetric body's surface."""

    def template(self, canonical: Gaussians) -> Template:
        """The Gaussians before they are posed, and the surface that they belong to."""
        ...


class HasKnots(Protocol):
    """Deformations whose motion is a spline over knots that other knots can replace.

    Training (`KnotSchedule`) and pruning (`hoigs study needs`) insert and remove knots of such a
    motion (`hoigs.core.model.knot_refit`).

    Attributes:
        knots: the times of the knots; another Knots may be assigned.
        keyframes: their number at the start.
        knot_axes: name of each parameter kept at the knots to the axis along which they lie.
    """

    knots: Knots
    keyframes: int
    knot_axes: Mapping[str, int]

    def get_parameter(self, target: str) -> nn.Parameter: ...

    def modules(self) -> Iterator[nn.Module]: ...

    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        """The parameters of `knot_axes` for this same motion with knots at `times`.

        Args:
            fit: times of the motion to which they are fitted; empty to read them off the motion,
                which is exact where knots are only added.
        """
        ...

    def traced(self, canonical: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        """World positions of some Gaussians (`probe_rows`) at some times, metres."""
        ...


def has_knots(deformation: object) -> TypeGuard[HasKnots]:
    """Whether a deformation is a `HasKnots`.

    Not by isinstance: since Python 3.12 that does not see a module's submodules, as `knots` is.
    """
    members = ("knots", "keyframes", "knot_axes", "resampled", "traced")
    return all(hasattr(deformation, name) for name in members)
