"""FeatureExtractor: tokens that describe an entity at a moment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, runtime_checkable

from torch import Tensor, nn

from hoigs.core.errors import class_name
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.parameters import TimeRows
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import TokenKind, Tokens
from hoigs.core.values.topology import TopologyChange, reindex


class FeatureExtractor(Configurable, nn.Module, ABC):
    """Describes one entity by M tokens for the interaction module, M of its own choice.

    The Entity calls `bind` once, then `forward` before the interaction module at every step.

    Attributes:
        requires: capabilities that the deformation must have (`DeformationModel.provides`).
        per_gaussian: names of this module's parameters whose first axis is the Gaussian.
        rates: as DeformationModel.rates.
        width: D, the width of the tokens; known after `bind`.
        tokens: what there is one token of: each "gaussian", in the entity's order, each "part" of
            the body (16, in the order of `interfaces.body.PART_NAMES`), or "any" other number. An
            interaction can displace single Gaussians only by their own tokens. May be set on the
            instance.
        time_rows, cuda_graph_safe: as those of DeformationModel.
    """

    requires: frozenset[str] = frozenset()
    per_gaussian: tuple[str, ...] = ()
    rates: ClassVar[Mapping[str, str]] = {}
    time_rows: Mapping[str, TimeRows] = MappingProxyType({})
    cuda_graph_safe: bool = False
    tokens: TokenKind = "any"
    width: int

    def bind(self, deformation: DeformationModel, canonical: Gaussians) -> None:
        """Allocate what depends on the deformation or on the number of Gaussians."""
        del deformation, canonical

    @abstractmethod
    def forward(
        self, deformation: DeformationModel, canonical: Gaussians, moment: Moment
    ) -> Tokens:
        """Tokens of the entity at `moment`: features [M, D] and world positions [M, 3], metres.

        Args:
            canonical: raw Gaussians in the deformation's `input_space`.
        """

    def on_topology(self, change: TopologyChange) -> None:
        """As `DeformationModel.on_topology`."""
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)


def check_provided(
    features: FeatureExtractor | type[FeatureExtractor],
    deformation: DeformationModel | type[DeformationModel],
) -> None:
    """Raise ValueError when `features` require a capability that `deformation` lacks."""
    missing = features.requires - deformation.provides
    if missing:
        raise ValueError(
            f"{class_name(features)} requires {', '.join(sorted(missing))}, but "
            f"{class_name(deformation)} provides "
            f"{', '.join(sorted(deformation.provides)) or 'nothing'}: leave the features out "
            "(features: null), or take a deformation that provides it"
        )


@runtime_checkable
class ReadsKnots(Protocol):
    """Extractors whose tokens depend on the knots of the deformation (`HasKnots`)."""

    def with_fewer_knots(
        self, before: int, after: int
    ) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
        """What keeps the tokens unchanged when the deformation has fewer uniform knots.

        Returns:
            settings that change, and tensors that change, by their name in `state_dict`; None
            where tokens cannot stay unchanged.
        """
        ...
