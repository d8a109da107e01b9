"""The distance mask B (HOIGS, Eq. 12), and its smooth form."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import logsigmoid

from hoigs.core.config import ComponentConfig
from hoigs.core.values.tokens import Role, Tokens


class DistanceGateConfig(ComponentConfig):
    """How near a human an object must be to take part in the interaction."""

    gate: Literal["soft", "hard", "none"] = "soft"
    """"hard" is the paper's B, -inf beyond d_th, by which residuals jump when the object crosses
    it; hence the default, "soft": sigmoid((d_th - d) / softness). "none" leaves B out."""
    granularity: Literal["object", "gaussian", "part"] = "object"
    """B is indexed by token pairs but defined by one distance for each object; hence the default,
    "object" (the paper): the distance of the mean of its tokens, which opens or closes the object
    as a whole. "gaussian" has one distance for each object token, "part" one for each pair of
    object token and body part, from the part's centroid whatever `reach_from` is."""
    reach_from: Literal["nearest", "pelvis"] = "nearest"
    """Where distances start: the "nearest" of pelvis, wrists and feet, the default, or the "pelvis"
    (the paper). Arm length from the pelvis is too short: the shoulder is 0.45 m above it, and what
    is held high or far out is masked exactly while it is held."""
    reach: float = Field(default=1.0, gt=0)
    """d_th in arm lengths, shoulder to middle fingertip, alpha included (the paper does not define
    whether its arm ends at the wrist: 0.75 is about that)."""
    softness: float = Field(default=0.05, gt=0)
    """Width of the soft gate's transition, metres."""


@torch.no_grad()
def log_gate(
    config: DistanceGateConfig, human: str, role: Role, parts: Tokens, item: Tokens
) -> Float[Tensor, "M N"]:
    """Logarithm of the gate of each of M body parts and N object tokens; -inf where closed.

    Raises:
        ValueError: the human, whose name is `human`, has no skeleton.
    """
    count, positions = len(parts.positions), item.positions
    if config.gate == "none":
        return positions.new_zeros(count, len(positions))
    if role.anchors is None or role.reach is None:
        raise ValueError(
            f'"{human}" has no skeleton from which to measure reach; give it a deformation that '
            "provides one, or set `gate: none`"
        )
    if config.granularity == "object":
        positions = positions.mean(0, keepdim=True)
    if config.granularity == "part":
        distances = torch.cdist(parts.positions, positions)
    else:
        anchors = role.anchors if config.reach_from == "nearest" else role.anchors[:1]
        distances = torch.cdist(anchors, positions).amin(0, keepdim=True)
    margin = config.reach * role.reach - distances
    if config.gate == "soft":
        log = logsigmoid(margin / config.softness)
    else:
        log = torch.where(margin > 0, 0.0, -torch.inf)
    return log.expand(count, len(item.positions))
