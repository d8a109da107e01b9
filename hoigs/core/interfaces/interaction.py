"""InteractionModule: tokens of all entities in, a residual for each out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from torch import nn

from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.values.tokens import EntityKind, Residual, Role, Tokens


class InteractionModule(Configurable, nn.Module, ABC):
    """Couples entities by residuals, which their deformations apply or ignore.

    The SceneModel calls `bind` once, then `forward` at every step once the warm-up is over
    (`train.warmup.interaction`). With no entity in reach residuals are zero or absent, never NaN.

    Attributes:
        cuda_graph_safe: as DeformationModel.cuda_graph_safe.
        reads: False if `forward` needs neither tokens nor roles: the scene then computes none and
            does not call it.
    """

    cuda_graph_safe: bool = False
    reads: bool = True

    def bind(self, widths: Mapping[str, int], kinds: Mapping[str, EntityKind]) -> None:
        """Allocate what depends on the entities.

        Args:
            widths: token width D of each entity that has features. kinds: kind of every entity.
        """
        del widths, kinds

    @abstractmethod
    def forward(
        self, tokens: Mapping[str, Tokens], roles: Mapping[str, Role]
    ) -> Mapping[str, Residual]:
        """Residuals by entity name; an entity without one stays as it is.

        Args:
            tokens: world-space tokens of each entity with features. roles: role of every entity.
        """
