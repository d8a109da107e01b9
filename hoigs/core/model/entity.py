"""Entity: canonical Gaussians, the deformation that moves them and the features that describe
them.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import ParamSpec, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.errors import HoigsError, PluginError, require_type
from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.deformation import DeformationModel, ProvidesSkeleton
from hoigs.core.interfaces.features import FeatureExtractor, check_provided
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.gaussians import FIELDS, Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import POSE_JOINTS, EntityKind, Residual, Role, Tokens
from hoigs.core.values.topology import TopologyChange, share_opacity


class Entity(nn.Module):
    """One human, one object, or the static scene.

    Its parameters are the raw fields of the canonical Gaussians and those of both components.

    Args:
        canonical: raw Gaussians in the deformation's `input_space`; all fields are trained but
            those that the deformation owns.
        deformation: how they move.
        features: tokens for the interaction module; None leaves the entity out of it.
        kind: by default "human" if the deformation provides a skeleton, "object" if there are
            features or the deformation has parameters, else "scene".

    Raises:
        ValueError: the features require a capability that the deformation lacks.
        TypeError: an argument is of another type.
    """

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    opacity_logits: nn.Parameter
    sh: nn.Parameter

    def __init__(
        self,
        canonical: Gaussians,
        deformation: DeformationModel,
        features: FeatureExtractor | None = None,
        *,
        kind: EntityKind | None = None,
    ) -> None:
        super().__init__()
        require_type("Entity", "canonical, the first argument,", canonical, Gaussians)
        require_type("Entity", "deformation, the second argument,", deformation, DeformationModel)
        if features is not None:
            require_type("Entity", "features", features, FeatureExtractor)
        self.deformation = deformation
        self.features = features
        if features is not None:
            check_provided(features, deformation)
        self.kind: EntityKind = kind or self._infer_kind()
        for name in FIELDS:
            value = getattr(canonical, name).detach().clone()
            trained = name not in deformation.owns
            setattr(self, name, nn.Parameter(value, requires_grad=trained))
        deformation.bind(self.canonical)
        if features is not None:
            features.bind(deformation, self.canonical)

    def _infer_kind(self) -> EntityKind:
        if "skeleton" in self.deformation.provides:
            return "human"
        moves = any(True for _ in self.deformation.parameters())
        return "object" if self.features is not None or moves or self.deformation.owns else "scene"

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def canonical(self) -> Gaussians:
        """The canonical Gaussians, raw; its tensors are this module's parameters."""
        return Gaussians(*(getattr(self, name) for name in FIELDS))

    @property
    def at_peak(self) -> Gaussians:
        """The canonical Gaussians, raw, each with the largest opacity that it has over time."""
        canonical = self.canonical
        return canonical.replace(opacity_logits=self.deformation.peak_opacity_logits(canonical))

    def tokens(self, moment: Moment) -> Tokens | None:
        """What the interaction module reads of this entity; None without features."""
        if self.features is None:
            return None
        return self.features(self.deformation, self.canonical, moment)

    def role(self, moment: Moment) -> Role:
        """The entity's kind and number of Gaussians and, of a human with a skeleton, where its
        reach begins and ends."""
        if self.kind == "human" and isinstance(self.deformation, ProvidesSkeleton):
            anchors, reach = self.deformation.anchors(moment), self.deformation.arm_length()
            return Role("human", anchors, reach, len(self))
        return Role(self.kind, gaussians=len(self))

    def forward(self, moment: Moment, residual: Residual | None = None) -> Gaussians:
        """The entity at `moment`: raw Gaussians in the world."""
        return self.deformation(self.canonical, moment, residual)

    def per_gaussian(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Every parameter whose first axis is the Gaussian, with its dotted name."""
        for name in FIELDS:
            yield name, self.get_parameter(name)
        for prefix in ("deformation", "features"):
            module = getattr(self, prefix)
            for name in module.per_gaussian if module is not None else ():
                yield f"{prefix}.{name}", module.get_parameter(name)

    @torch.no_grad()
    def apply_topology(self, change: TopologyChange, canonical: Gaussians) -> None:
        """Take M new canonical Gaussians; deformation and features follow by one index map.

        Parameter objects stay and only their data changes, so optimizer groups remain valid.
        """
        for name in FIELDS:
            parameter = self.get_parameter(name)
            parameter.grad = None
            parameter.data = getattr(canonical, name).detach().clone()
        self.deformation.on_topology(change)
        if change.copies is not None:
            for name in self.deformation.per_gaussian:
                if name.rpartition(".")[2] == "opacity_logits":
                    keyed = self.deformation.get_parameter(name)
                    keyed.data = share_opacity(keyed.data, change.copies)
        if self.features is not None:
            self.features.on_topology(change)

    @torch.no_grad()
    def displace(self, offsets: Float[Tensor, "N 3"]) -> None:
        """Add offsets, metres, to the canonical means and to means that the deformation owns."""
        self.means.data += offsets
        if "means" in self.deformation.owns:
            self.deformation.on_topology(TopologyChange.displaced(offsets))

    def resize(self, count: int) -> None:
        """Allocate `count` Gaussians with arbitrary values, before a checkpoint is loaded."""
        if count == len(self):
            return  # keep what the deformation derived from its points when it was bound
        source = torch.arange(count, device=self.means.device) % max(1, len(self))
        change = TopologyChange(
            source,
            torch.zeros(count, dtype=torch.bool, device=source.device),
            torch.zeros(count, 3, device=source.device),
        )
        self.apply_topology(change, self.canonical[source])

    def regularizers(self) -> dict[str, Tensor]:
        return self.deformation.regularizers()


# Failures of a plugin's component, and what it gives in a wrong shape, with its name.

Args = ParamSpec("Args")
Result = TypeVar("Result")


def name_of(part: object) -> str:
    """The class of a component, as its plugin names it: "acme_bounce.Bounce"."""
    return f"{type(part).__module__}.{type(part).__qualname__}"


def call(
    part: object, role: str, work: Callable[Args, Result], *args: Args.args, **more: Args.kwargs
) -> Result:
    """`work(*args)`, a method of `part`; what a component from elsewhere raises gets its name.

    Exceptions of hoigs' own components pass unchanged.

    Args:
        role: of the part, for the message: "deformation of 'object'".

    Raises:
        PluginError: a component that is not of hoigs raised something.
    """
    try:
        return work(*args, **more)
    except HoigsError:
        raise
    except Exception as error:
        if type(part).__module__.partition(".")[0] == "hoigs":
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        raise PluginError(
            f"{role}: {name_of(part)} raised {type(error).__name__}: {error} "
            f"({Path(last.filename).name}:{last.lineno}); this is a fault of the plugin that it "
            "came with (HOIGS_TRACEBACK=1 shows where)"
        ) from error


def require_tokens(features: FeatureExtractor, name: str, tokens: Tokens, gaussians: int) -> None:
    """Raise PluginError when tokens of the entity `name` have a wrong shape, or are not as many as
    the features declare."""
    found, count = tuple(tokens.features.shape), len(tokens.positions)
    who = f"features of {name!r}: {name_of(features)}"
    if found != (count, features.width) or tuple(tokens.positions.shape) != (count, 3):
        raise PluginError(
            f"{who} gave features {list(found)} at positions {list(tokens.positions.shape)}, "
            f"expected [M, {features.width}], its width, and [M, 3]"
        )
    declared = {"gaussian": gaussians, "part": len(PART_NAMES), "any": count}[features.tokens]
    if count != declared:
        raise PluginError(
            f"{who} declares tokens {features.tokens!r}, that is {declared} here, and gave {count}"
        )


def require_residuals(
    module: InteractionModule,
    residuals: Mapping[str, Residual],
    tokens: Mapping[str, Tokens],
    features: Mapping[str, FeatureExtractor],
    gaussians: Mapping[str, int],
) -> None:
    """Raise PluginError when a residual has another shape than what it corrects: torch would
    broadcast [1, 3], and of any other shape the deformation that applies it would be blamed.

    Args:
        features: by entity. gaussians: number of each entity's.
    """
    who = f"interaction: {name_of(module)}"
    for name, residual in residuals.items():
        if name not in gaussians:
            raise PluginError(
                f"{who} corrects {name!r}; the entities are {', '.join(map(repr, gaussians))}"
            )
        count = gaussians[name]
        if not _has(residual.pose, POSE_JOINTS):
            raise PluginError(
                f"{who} corrects the pose of {name!r} by {_shape(residual.pose)}, expected "
                f"[{POSE_JOINTS}, 3]"
            )
        if _has(residual.means, count):
            continue
        why = ""
        if name in tokens and _has(residual.means, len(tokens[name].features)):
            why = (
                f": the features of {name!r}, {name_of(features[name])}, gave "
                f"{len(tokens[name].features)} tokens, and this interaction needs a token for each "
                "Gaussian; take other features or another interaction"
            )
        raise PluginError(
            f"{who} moves the means of {name!r} by {_shape(residual.means)}, expected "
            f"[{count}, 3], a row for each Gaussian{why}"
        )


def _has(part: Tensor | None, rows: int) -> bool:
    return part is None or tuple(part.shape) == (rows, 3)


def _shape(part: Tensor | None) -> list[int]:
    return [] if part is None else list(part.shape)
