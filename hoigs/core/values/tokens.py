"""Input and output of the interaction module: Tokens and Role in, Residual out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from hoigs.core.values.shown import one_line

EntityKind = Literal["scene", "human", "object"]
TokenKind = Literal["gaussian", "part", "any"]
POSE_JOINTS = 51  # that a residual corrects: 21 of the body, 15 of each hand


@dataclass(frozen=True)
class Tokens:
    """M feature vectors of one entity, each at a point in the world.

    Attributes:
        features: rows of the width D of the entity's FeatureExtractor. positions: metres.
    """

    features: Float[Tensor, "M D"]
    positions: Float[Tensor, "M 3"]

    __repr__ = one_line


@dataclass(frozen=True)
class Role:
    """What the interaction module knows of an entity at a moment besides its tokens.

    Attributes:
        kind: scene, human or object.
        anchors: points of a human from which reach is measured: pelvis, left wrist, right
            wrist, left foot, right foot; world, metres.
        reach: arm length of a human, metres.
        gaussians: N, as many as it has now: the rows of `Residual.means`.
    """

    kind: EntityKind
    anchors: Float[Tensor, "A 3"] | None = None
    reach: Float[Tensor, ""] | None = None
    gaussians: int = 0


@dataclass(frozen=True)
class Residual:
    """A correction of one entity by the interaction module (HOIGS, Sec. "Interaction Module").

    Attributes:
        pose: added to the axis-angle of body (21), left hand (15), right hand (15), radians.
        means: added to the means in the world, metres.
    """

    pose: Float[Tensor, "51 3"] | None = None
    means: Float[Tensor, "N 3"] | None = None

    __repr__ = one_line


def displaced(means: Float[Tensor, "N 3"], residual: Residual | None) -> Float[Tensor, "N 3"]:
    """World means with the displacement of the residual, where there is one."""
    return means if residual is None or residual.means is None else means + residual.means
