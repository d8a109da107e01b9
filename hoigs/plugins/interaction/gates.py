"""The distance mask B of HOIGS and what it becomes when it must be smooth (methods A.6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid

from hoigs.core.features import Tokens
from hoigs.core.interaction import Role

GateKind = Literal["soft", "hard", "none"]
Granularity = Literal["object", "gaussian", "part"]
ReachFrom = Literal["nearest", "pelvis"]


@dataclass(frozen=True)
class DistanceGate:
    """How near a human an object must be to take part in the interaction.

    Attributes:
        kind: "hard" is the paper's B, -inf beyond d_th: residuals pop when the object crosses it;
            hence the default, "soft": sigmoid((d_th - d) / softness). "none" lets everything
            through.
        granularity: B is indexed by token pairs but defined by one distance an object; so, by
            default, "object" (the paper): the distance of its centre, the mean of its tokens, which
            opens or shuts it as a whole. "gaussian" has one distance for each object token, "part"
            one for each pair of object token and body part, from the part's centroid whatever
            `reach_from` says.
        reach_from: "nearest" of pelvis, wrists and feet, the default, or the "pelvis" (the paper).
            Arm length from the pelvis is too short: the shoulder alone is 0.45 m above it, and what
            is held high or far out is shut exactly while it is held.
        softness: metres.
        reach: d_th in arm lengths, shoulder to middle fingertip, alpha included (whether the
            paper's arm ends at the wrist is open: 0.75 is about that).
    """

    kind: GateKind = "soft"
    granularity: Granularity = "object"
    reach_from: ReachFrom = "nearest"
    softness: float = 0.05
    reach: float = 1.0

    @torch.no_grad()
    def log(self, human: str, role: Role, parts: Tokens, thing: Tokens) -> Float[Tensor, "M N"]:
        """Logarithm of the gate of each of M parts and N object tokens; -inf where shut."""
        count, positions = len(parts.positions), thing.positions
        if self.kind == "none":
            return positions.new_zeros(count, len(positions))
        if role.anchors is None or role.reach is None:
            raise ValueError(
                f'"{human}" has no skeleton to measure reach from; give it a deformation that '
                "provides one, or set `gate: none`"
            )
        if self.granularity == "object":
            positions = positions.mean(0, keepdim=True)
        if self.granularity == "part":
            distances = torch.cdist(parts.positions, positions)
        else:
            anchors = role.anchors if self.reach_from == "nearest" else role.anchors[:1]
            distances = torch.cdist(anchors, positions).amin(0, keepdim=True)
        margin = self.reach * role.reach - distances
        if self.kind == "soft":
            log = logsigmoid(margin / self.softness)
        else:
            log = torch.where(margin > 0, 0.0, -torch.inf)
        return log.expand(count, len(thing.positions))
