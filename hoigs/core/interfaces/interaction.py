"""InteractionModule: tokens of all entities in, a residual for each out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType

from torch import nn

from hoigs.core.errors import class_name
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.values.tokens import EntityKind, Residual, Role, TokenKind, Tokens


class InteractionModule(Configurable, nn.Module, ABC):
    """Couples entities by residuals, which their deformations apply or ignore.

    The SceneModel calls `bind` once, then `forward` at every step once the warm-up is over
    (`train.warmup.interaction`). With no entity in reach residuals are zero or absent, never NaN.

    Attributes:
        cuda_graph_safe: as DeformationModel.cuda_graph_safe.
        tokens: the tokens that it needs of a kind of entity, as `FeatureExtractor.tokens` declares
            them; "any" number of a kind that is not in it. Residuals of means have a row for each
            Gaussian (`Role.gaussians`), so one that gives a row for each token needs "gaussian".
        reads: False if `forward` needs neither tokens nor roles: the scene then computes none and
            does not call it.
    """

    cuda_graph_safe: bool = False
    reads: bool = True
    tokens: Mapping[EntityKind, TokenKind] = MappingProxyType({})

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


WORDS = {"gaussian": "for each Gaussian", "part": "for each body part"}


def check_tokens(
    interaction: InteractionModule | type[InteractionModule],
    features: FeatureExtractor | type[FeatureExtractor],
    kind: EntityKind,
) -> None:
    """Raise ValueError when features of an entity of `kind` declare other tokens than the
    interaction needs. Features that declare "any" are known by what they give alone."""
    needed, given = interaction.tokens.get(kind, "any"), features.tokens
    if "any" in (needed, given) or needed == given:
        return
    raise ValueError(
        f"{class_name(interaction)} needs a token {WORDS[needed]} of each {kind}, and "
        f"{class_name(features)} gives one {WORDS[given]}: take other features, leave them out "
        "(features: null), or take another interaction"
    )
