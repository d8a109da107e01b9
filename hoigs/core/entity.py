"""Entity: rest Gaussians with the model that moves them and the features that describe them."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.deformation import DeformationModel, ProvidesSkeleton
from hoigs.core.features import FeatureExtractor, Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import EntityKind, Residual, Role
from hoigs.core.moment import Moment
from hoigs.core.topology import TopologyChange, share_opacity

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


class Entity(nn.Module):
    """One thing in the scene.

    Args:
        rest: canonical Gaussians; trained, but for the fields that the deformation owns.
        deformation: how they move.
        features: how they are described to the interaction module; None takes no part in it.
        kind: scene, human or object; by default human if the deformation provides a skeleton,
            object if it has features or moves, else scene.
    """

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    opacity_logits: nn.Parameter
    sh: nn.Parameter

    def __init__(
        self,
        rest: Gaussians,
        deformation: DeformationModel,
        features: FeatureExtractor | None = None,
        *,
        kind: EntityKind | None = None,
    ) -> None:
        super().__init__()
        self.deformation = deformation
        self.features = features
        if features is not None and not features.requires <= deformation.provides:
            missing = sorted(features.requires - deformation.provides)
            raise ValueError(
                f"{type(features).__name__} requires {missing}, but {type(deformation).__name__} "
                f"provides {sorted(deformation.provides) or 'nothing'}"
            )
        self.kind: EntityKind = kind or self._infer_kind()
        for name in FIELDS:
            value = getattr(rest, name).detach().clone()
            trained = name not in deformation.owns
            setattr(self, name, nn.Parameter(value, requires_grad=trained))
        deformation.bind(self.rest)
        if features is not None:
            features.bind(deformation, self.rest)

    def _infer_kind(self) -> EntityKind:
        if "skeleton" in self.deformation.provides:
            return "human"
        moves = any(True for _ in self.deformation.parameters())
        return "object" if self.features is not None or moves or self.deformation.owns else "scene"

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def rest(self) -> Gaussians:
        return Gaussians(*(getattr(self, name) for name in FIELDS))

    @property
    def at_peak(self) -> Gaussians:
        """The rest Gaussians with the largest opacity that each has over time."""
        rest = self.rest
        return rest.replace(opacity_logits=self.deformation.peak_opacity_logits(rest))

    def tokens(self, moment: Moment) -> Tokens | None:
        if self.features is None:
            return None
        return self.features(self.deformation, self.rest, moment)

    def role(self, moment: Moment) -> Role:
        if self.kind == "human" and isinstance(self.deformation, ProvidesSkeleton):
            return Role("human", self.deformation.anchors(moment), self.deformation.arm_length())
        return Role(self.kind)

    def forward(self, moment: Moment, residual: Residual | None = None) -> Gaussians:
        return self.deformation(self.rest, moment, residual)

    def per_gaussian(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Every parameter whose first axis is the Gaussian, with its dotted name."""
        for name in FIELDS:
            yield name, self.get_parameter(name)
        for prefix in ("deformation", "features"):
            module = getattr(self, prefix)
            for name in module.per_gaussian if module is not None else ():
                yield f"{prefix}.{name}", module.get_parameter(name)

    @torch.no_grad()
    def apply_topology(self, change: TopologyChange, rest: Gaussians) -> None:
        """Take M new rest Gaussians; deformation and features follow by the same index map."""
        for name in FIELDS:
            parameter = self.get_parameter(name)
            parameter.grad = None
            parameter.data = getattr(rest, name).detach().clone()
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
        """Move every Gaussian by an offset in rest coordinates, metres; nothing else changes."""
        self.means.data += offsets
        if "means" in self.deformation.owns:  # it keeps positions of its own
            self.deformation.on_topology(TopologyChange.displaced(offsets))

    def resize(self, count: int) -> None:
        """Allocate `count` Gaussians with arbitrary content: before loading a checkpoint."""
        if count == len(self):
            return  # what a deformation derives from its points stays as it was bound
        source = torch.arange(count, device=self.means.device) % max(1, len(self))
        change = TopologyChange(
            source,
            torch.zeros(count, dtype=torch.bool, device=source.device),
            torch.zeros(count, 3, device=source.device),
        )
        self.apply_topology(change, self.rest[source])

    def regularizers(self) -> dict[str, Tensor]:
        return self.deformation.regularizers()
