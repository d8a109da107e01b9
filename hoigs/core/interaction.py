"""InteractionModule: tokens of all entities in, a residual for each out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.features import Tokens

if TYPE_CHECKING:
    from hoigs.core.context import BuildContext

EntityKind = Literal["scene", "human", "object"]


@dataclass(frozen=True)
class Residual:
    """A correction that the interaction module asks of a deformation.

    Attributes:
        pose: added to the axis-angle of body (21), left hand (15), right hand (15), radians.
        means: added to the means in the world, metres.
    """

    pose: Float[Tensor, "51 3"] | None = None
    means: Float[Tensor, "N 3"] | None = None


@dataclass(frozen=True)
class Role:
    """What an entity is to the others at a moment.

    Attributes:
        kind: scene, human or object.
        anchors: for a human, the points from which reach is measured: pelvis, left wrist, right
            wrist, left foot, right foot; world, metres.
        reach: for a human, arm length, metres.
    """

    kind: EntityKind
    anchors: Float[Tensor, "A 3"] | None = None
    reach: Float[Tensor, ""] | None = None


class InteractionModule(nn.Module, ABC):
    """Couples entities. One that finds nothing in reach returns zero residuals, never NaN.

    Attributes:
        recordable: as DeformationModel.recordable.
        reads: whether it reads tokens and roles; where it does not, they are not computed.
    """

    recordable: bool = False
    reads: bool = True

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(**config.model_dump())

    def bind(self, widths: Mapping[str, int], kinds: Mapping[str, EntityKind]) -> None:
        """Called once by the SceneModel with the token width and kind of each entity."""
        del widths, kinds

    @abstractmethod
    def forward(
        self, tokens: Mapping[str, Tokens], roles: Mapping[str, Role]
    ) -> Mapping[str, Residual]:
        """Residuals by entity name; an entity without one is left alone."""
