"""FeatureExtractor: tokens that describe an entity at a moment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.core.topology import TopologyChange, reindex

if TYPE_CHECKING:
    from hoigs.core.context import BuildContext


@dataclass(frozen=True)
class Tokens:
    """M feature vectors with the place of each in the world.

    Attributes:
        features: any width D.
        positions: metres, world.
    """

    features: Float[Tensor, "M D"]
    positions: Float[Tensor, "M 3"]


class FeatureExtractor(nn.Module, ABC):
    """Tokens of one entity for the interaction module.

    Attributes:
        requires: what the entity's deformation must list in `provides`.
        per_gaussian: names of this module's parameters whose first axis is the Gaussian.
        rates: as DeformationModel.rates.
        width: D, the width of the tokens.
        recordable: as DeformationModel.recordable.
    """

    requires: frozenset[str] = frozenset()
    per_gaussian: tuple[str, ...] = ()
    rates: ClassVar[Mapping[str, str]] = {}
    recordable: bool = False
    width: int

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(**config.model_dump())

    def bind(self, deformation: DeformationModel, rest: Gaussians) -> None:
        """Called once by the Entity: allocate what depends on the deformation or on N."""
        del deformation, rest

    @abstractmethod
    def forward(self, deformation: DeformationModel, rest: Gaussians, moment: Moment) -> Tokens:
        """Tokens of the entity at `moment`."""

    def on_topology(self, change: TopologyChange) -> None:
        reindex((self.get_parameter(name) for name in self.per_gaussian), change)
