"""DeformationModel: rest Gaussians and a moment in, Gaussians at that moment out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.camera import Camera
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import BodyPose, Moment
from hoigs.core.topology import AxisChange, TopologyChange, reindex

if TYPE_CHECKING:
    from hoigs.core.context import BuildContext
    from hoigs.core.interaction import Residual


@dataclass(frozen=True)
class StepEvidence:
    """What training saw of one entity at one step, for deformations that grow or shrink.

    Attributes:
        moment, camera: of the frame drawn.
        error: image loss there: the entity's own term if it has one, else the scene's.
        screen_gradient: of the loss by each Gaussian's place on the screen, or None.
        radii: on the screen, pixels; 0 where not drawn.
        step, total_steps: the number of this step, from 1, and of all.
    """

    moment: Moment
    camera: Camera
    error: float
    screen_gradient: Float[Tensor, "N 2"] | None
    radii: Float[Tensor, " N"]
    step: int
    total_steps: int


class DeformationModel(nn.Module, ABC):
    """How one entity moves.

    Attributes:
        provides: what features may ask of it: "velocity" (ProvidesVelocity), "field"
            (ProvidesField), "skeleton" (ProvidesSkeleton), "face" (ProvidesFace).
        owns: names of Gaussians fields that this model computes from parameters of its own; the
            entity does not train its rest values of those fields.
        per_gaussian: names of this module's parameters whose first axis is the Gaussian.
        rates: parameter-name prefix to the learning rate it takes (a key of the spec's
            `train.rates`, for example "planes" or "keyframes"); the others take "networks".
        regularizer_weights: default weight of each penalty of `regularizers`; 0 where absent.
        residuals: which parts of a Residual it applies: "means", "pose". What it does not name
            changes nothing, or is refused with an error.
        moves: False where the output is the rest at every moment, but for a residual.
        continuous: whether it is continuous in time: a small step of time is a small change.
        cut_gradients: rest fields, and prefixes of parameter names, whose gradient stops on some
            way to the output, by design; what arrives is not the derivative.
        rest_space: where it expects the rest Gaussians: "canonical" (a body in its zero pose, an
            object about its centre), when it knows the body or the track that places them; else
            "world". May be set on the instance.
        recordable: whether training may record it as a CUDA graph (`hoigs.core.recordable`).
    """

    provides: frozenset[str] = frozenset()
    owns: frozenset[str] = frozenset()
    per_gaussian: tuple[str, ...] = ()
    rates: ClassVar[Mapping[str, str]] = {}
    regularizer_weights: ClassVar[Mapping[str, float]] = {}
    residuals: frozenset[str] = frozenset({"means"})
    moves: bool = True
    continuous: bool = True
    cut_gradients: frozenset[str] = frozenset()
    rest_space: Literal["canonical", "world"] = "canonical"
    recordable: bool = False
    progress: float = 1.0

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        """Build from a validated config; override to take a body, a track … from the context."""
        return cls(**config.model_dump())

    def bind(self, rest: Gaussians) -> None:
        """Called once by the Entity: allocate what depends on the number of Gaussians."""
        del rest

    @abstractmethod
    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        """The entity at `moment`, in world coordinates.

        Args:
            rest: its canonical Gaussians, raw.
            moment: time, and the body pose of this entity if it has one.
            residual: correction from the interaction module; None is no correction.
        """

    def means_at(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """The means alone of `forward` without a residual, for features that need no more."""
        means: Tensor = self(rest, moment).means
        return means

    def hold(self, rest: Gaussians, moment: Moment) -> None:
        """Called on a model in eval mode that changes no more, before many moments are asked of it
        without gradients: a chance to compute once what depends on neither time nor pose.

        Body shapes (`BodyPose.betas`) are those of `moment` from then on. `train()` ends it.
        """
        del rest, moment

    def set_progress(self, progress: float) -> None:
        """Called before each training step, and with 1 after the last."""
        self.progress = progress

    def peak_opacity_logits(self, rest: Gaussians) -> Float[Tensor, " N"]:
        """The largest opacity logit of each Gaussian over time, by which density control judges it.

        The default is that at rest; a deformation that keys opacities knows better.
        """
        return rest.opacity_logits

    def on_topology(self, change: TopologyChange) -> None:
        """Follow a change of Gaussian count; the default reindexes `per_gaussian` parameters."""
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)

    def axis_changes(self, change: TopologyChange) -> Mapping[str, AxisChange]:
        """How parameters that hold rows of only some Gaussians will follow, by name.

        Asked before `on_topology`, for the optimizer's moments.
        """
        del change
        return {}

    def evolve(self, rest: Gaussians, evidence: StepEvidence) -> Mapping[str, AxisChange]:
        """Called after every step, before density control: a chance to change its own size.

        A deformation that inserts knots or promotes Gaussians gives the parameters their new
        values here (`parameter.data`, with `grad` None; the Parameter objects stay) and returns,
        by parameter name, how the optimizer's moments follow.

        What it remembers from step to step belongs in persistent buffers, and what it decides
        must not be random, so that a resumed run equals an unbroken one.
        """
        del rest, evidence
        return {}

    def regularizers(self) -> dict[str, Tensor]:
        """Named scalar penalties, unweighted, of the current parameters."""
        return {}


@runtime_checkable
class ProvidesVelocity(Protocol):
    """Deformations with "velocity" in `provides`."""

    def velocity(self, rest: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """Time derivative of the means, metres per keyframe interval or per unit time."""
        ...


@runtime_checkable
class ProvidesField(Protocol):
    """Deformations with "field" in `provides`: a space-time feature field phi(x, y, z, t)."""

    field_width: int

    def posed_field(
        self, rest: Gaussians, moment: Moment
    ) -> tuple[Float[Tensor, "V D"], Float[Tensor, "V 3"]]:
        """Features of the body's points at `moment` and their world positions, metres."""
        ...

    def field_parts(self) -> Tensor:
        """Body part (0..15) of each point of `posed_field`, int64 [V]."""
        ...


@runtime_checkable
class ProvidesSkeleton(Protocol):
    """Deformations with "skeleton" in `provides`: a posed body."""

    entity: str

    def point_parts(self) -> Tensor:
        """Body part (0..15) of each Gaussian, int64 [N]."""
        ...

    def pose(self, moment: Moment) -> BodyPose:
        """The pose used at `moment`, refinements included."""
        ...

    def anchors(self, moment: Moment) -> Float[Tensor, "A 3"]:
        """World positions, metres: pelvis, left wrist, right wrist, left foot, right foot."""
        ...

    def arm_length(self) -> Float[Tensor, ""]:
        """Shoulder to middle fingertip in world units (the learnable alpha included)."""
        ...


@runtime_checkable
class ProvidesFace(Protocol):
    """Deformations with "face" in `provides`: a body that has a face."""

    def face_points(self) -> tuple[Tensor, Float[Tensor, "F 3"]]:
        """Rows of the Gaussians on the face, int64 [F], and their outward unit normals at rest."""
        ...
