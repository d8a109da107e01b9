"""interaction:cross-attention: HOIGS's HOI module (Sec. "Cross-Attention Interaction Module")."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.body import BODY_JOINT_PARTS, PART_NAMES
from hoigs.core.clock import constant
from hoigs.core.config import ComponentConfig
from hoigs.core.features import Tokens
from hoigs.core.interaction import EntityKind, InteractionModule, Residual, Role
from hoigs.core.rotation import axis_angle_to_matrices
from hoigs.plugins.interaction.gates import DistanceGate, GateKind, Granularity, ReachFrom

Values = Literal["gated", "swapped"]
ObjectResidual = Literal["per-gaussian", "rigid", "both"]
PoseHead = Literal["flat", "per-part"]
Places = Literal["none", "hands"]

POSE_JOINTS = 51  # 21 of the body, 15 of each hand
LEFT_HAND, RIGHT_HAND = 8, 9
PLACE_UNIT = 0.1  # metres: of the size of corrections
# part of each joint that has a correction; the root has none
JOINT_PARTS = (*BODY_JOINT_PARTS[1:], *(LEFT_HAND,) * 15, *(RIGHT_HAND,) * 15)


class CrossAttentionConfig(ComponentConfig):
    """The paper's module and its readings (methods A.6, A.7).

    Attributes:
        width: d of queries, keys and values; the paper's 32.
        values: the printed products do not fit: softmax(Q_h K_o^T) is [16, N_o], V_h [16, d].
            "swapped" reads A V_other, ordinary cross-attention; to exchange the two printed
            outputs instead, the third way to make them fit, is the same thing. "gated", the
            default, is V_self + g A V_other: it keeps the printed V_self, so that a token knows
            of itself what it corrects.
        gate, granularity, reach_from, reach, softness: see DistanceGate, with the reasons.
        pose_head: how the 16 tokens become 51 corrections is left open. "flat", the default,
            is one MLP of all of them, so that an elbow may follow from what the hand does;
            "per-part" reads each joint from its own part's token, gated by that part's gate.
        object_residual: "per-gaussian" (the paper, and the default for that: it can bend a rigid
            thing), one "rigid" motion of the object, or "both".
        hidden: of the two heads; sizes are not given.
        pose_bound: largest correction of a joint's axis-angle, radians an axis: beyond small
            ones, adding axis-angles is no composition, and unbounded ones run away.
        means_bound: largest displacement of an object's Gaussian, metres an axis.
        places: what the residuals are told of geometry. "none" is the paper: tokens alone.
            "hands", which the spec hoigs sets, adds to F'_O and F'_H a linear map of where both
            hands are from the object's centre, world axes, gated as all that comes from another.
            Without it an object does not follow hands off its spline: phi, read in planes where
            a hand is, tells of that place only in frames that were trained on, and no token tells
            where the spline has put the object.
    """

    width: int = Field(32, ge=1)
    values: Values = "gated"
    gate: GateKind = "soft"
    granularity: Granularity = "object"
    reach_from: ReachFrom = "nearest"
    reach: float = Field(1.0, gt=0)
    softness: float = Field(0.05, gt=0)
    pose_head: PoseHead = "flat"
    object_residual: ObjectResidual = "per-gaussian"
    hidden: int = Field(128, ge=1)
    pose_bound: float = Field(0.3, gt=0)
    means_bound: float = Field(0.1, gt=0)
    places: Places = "none"


class CrossAttention(InteractionModule):
    """Humans attend to the tokens of all objects, and objects to the parts of all humans.

    F'_H = V_h + g softmax(Q_h K_o^T / sqrt(d) + B) V_o, and the mirror image for objects; one head,
    no normalisation, no output projection, as none is mentioned. MLPs
    turn F'_H into the pose correction of body and hands, F'_O into displacements of the object's
    Gaussians. B is the logarithm of the distance gate; as a softmax ignores what all its entries
    share, the gate g (the widest of a row) also multiplies every residual: what is out of reach
    has a residual of zero, whose gradients are zero too. Gates carry no gradient.

    With `places` "hands" both get + sum over the others of g (W d + b), d from `from_object`.

    Both heads start at zero. Entities of one kind with tokens of one width share their weights.
    Object tokens are one a Gaussian, human tokens one a body part.
    """

    recordable = True

    def __init__(
        self,
        width: int = 32,
        values: Values = "gated",
        gate: GateKind = "soft",
        granularity: Granularity = "object",
        reach_from: ReachFrom = "nearest",
        reach: float = 1.0,
        softness: float = 0.05,
        pose_head: PoseHead = "flat",
        object_residual: ObjectResidual = "per-gaussian",
        hidden: int = 128,
        pose_bound: float = 0.3,
        means_bound: float = 0.1,
        places: Places = "none",
    ) -> None:
        super().__init__()
        self.width, self.gated = width, values == "gated"
        self.gate = DistanceGate(gate, granularity, reach_from, softness, reach)
        self.per_gaussian = object_residual in ("per-gaussian", "both")
        self.rigid = object_residual in ("rigid", "both")
        self.pose_bound, self.means_bound = pose_bound, means_bound
        self.projections = nn.ModuleDict()
        self.local = pose_head == "per-part"
        entry = width if self.local else len(PART_NAMES) * width
        self.pose_head = zero_headed(entry, hidden, 3 * POSE_JOINTS)
        if self.per_gaussian:
            self.means_head = zero_headed(width, hidden, 3)
        if self.rigid:
            self.twist_head = zero_headed(width, hidden, 6)
        self.places = nn.ModuleDict()
        if places == "hands":
            self.places["human"] = nn.Linear(6, width)
            self.places["object"] = nn.Linear(6, width)

    def bind(self, widths: Mapping[str, int], kinds: Mapping[str, EntityKind]) -> None:
        for name, width in widths.items():
            key = f"{kinds[name]}_{width}"
            if kinds[name] != "scene" and key not in self.projections:
                self.projections[key] = nn.Linear(width, 3 * self.width, bias=False)

    def forward(
        self, tokens: Mapping[str, Tokens], roles: Mapping[str, Role]
    ) -> Mapping[str, Residual]:
        humans = [name for name in tokens if roles[name].kind == "human"]
        things = [name for name in tokens if roles[name].kind == "object"]
        if not humans or not things:
            return {}
        for name in humans:
            if len(tokens[name].features) != len(PART_NAMES):
                raise ValueError(
                    f'"{name}" has {len(tokens[name].features)} tokens; a human needs '
                    f"{len(PART_NAMES)}, one a body part"
                )
        projected = {n: self._project(roles[n].kind, tokens[n]) for n in humans + things}
        log_gates = {
            (h, o): self.gate.log(h, roles[h], tokens[h], tokens[o]) for h in humans for o in things
        }
        there = [o for o in things if len(tokens[o].positions)]
        offsets = {(h, o): from_object(tokens[h], tokens[o]) for h in humans for o in there}
        residuals = {}
        for h in humans:
            bias = torch.cat([log_gates[h, o] for o in things], dim=1)
            attended, gates = self._attend(projected[h], [projected[o] for o in things], bias)
            seen = [(offsets[h, o], log_gates[h, o].amax(1)) for o in there]
            attended = self._placed("human", attended, seen)
            residuals[h] = Residual(pose=self._pose(attended, gates))
        for o in things:
            bias = torch.cat([log_gates[h, o].mT for h in humans], dim=1)
            attended, gates = self._attend(projected[o], [projected[h] for h in humans], bias)
            seen = [(offsets[h, o], log_gates[h, o].amax(0)) for h in humans if o in there]
            attended = self._placed("object", attended, seen)
            means = self._means(attended, gates, tokens[o].positions.detach())
            residuals[o] = Residual(means=means)
        return residuals

    def _project(self, kind: EntityKind, tokens: Tokens) -> Float[Tensor, "M QKV"]:
        """Queries, keys and values of one entity, side by side."""
        return self.projections[f"{kind}_{tokens.features.shape[1]}"](tokens.features)

    def _attend(
        self,
        own: Float[Tensor, "M QKV"],
        others: list[Tensor],
        bias: Float[Tensor, "M N"],
    ) -> tuple[Float[Tensor, "M d"], Float[Tensor, " M"]]:
        """F' of one entity's tokens, and the gate of each."""
        query, _, value = own.chunk(3, dim=-1)
        _, keys, values = torch.cat(others).chunk(3, dim=-1)
        gates = bias.amax(1).exp()
        # a row that is shut everywhere would be NaN; its weights do not matter, its gate is zero
        bias = torch.where(torch.isneginf(bias).all(1, keepdim=True), 0.0, bias)
        weights = (query @ keys.mT / self.width**0.5 + bias).softmax(-1)
        attended = gates[:, None] * (weights @ values)
        return (value + attended if self.gated else attended), gates

    def _placed(
        self,
        kind: EntityKind,
        attended: Float[Tensor, "M d"],
        pairs: list[tuple[Tensor, Tensor]],
    ) -> Float[Tensor, "M d"]:
        """F' and what places add: offsets [6] and log-gates [M], for each entity of the other."""
        if kind not in self.places or not pairs:
            return attended
        added = [log[:, None].exp() * self.places[kind](offset) for offset, log in pairs]
        return attended + torch.stack(added).sum(0)

    def _pose(
        self, attended: Float[Tensor, "M d"], gates: Float[Tensor, " M"]
    ) -> Float[Tensor, "51 3"]:
        """delta theta: of all tokens flattened, or of each joint's own part; bounded, gated."""
        if self.local:
            parts = constant(JOINT_PARTS, attended, torch.long)
            every = self.pose_head(attended).unflatten(1, (POSE_JOINTS, 3))
            raw = every[parts, torch.arange(POSE_JOINTS, device=parts.device)]
            return gates[parts, None] * self.pose_bound * torch.tanh(raw)
        raw = self.pose_head(attended.flatten()).unflatten(0, (POSE_JOINTS, 3))
        return gates.max() * self.pose_bound * torch.tanh(raw)

    def _means(
        self,
        attended: Float[Tensor, "N d"],
        gates: Float[Tensor, " N"],
        positions: Float[Tensor, "N 3"],
    ) -> Float[Tensor, "N 3"]:
        """delta G: free for each Gaussian, or one small motion about the object's centre."""
        means = torch.zeros_like(positions)
        if self.per_gaussian:
            raw = self.means_head(attended)
            means = means + gates[:, None] * self.means_bound * torch.tanh(raw)
        if self.rigid:
            twist = torch.tanh(self.twist_head(attended.mean(0))) * gates.max()
            turn = axis_angle_to_matrices(self.pose_bound * twist[:3])
            arms = positions - positions.mean(0)
            means = means + arms @ turn.mT - arms + self.means_bound * twist[3:]
        return means


def from_object(human: Tokens, thing: Tokens) -> Float[Tensor, "6"]:
    """Both hands of a human seen from an object's centre, world axes, in PLACE_UNIT."""
    hands = human.positions[LEFT_HAND : RIGHT_HAND + 1].detach()
    return ((hands - thing.positions.detach().mean(0)) / PLACE_UNIT).flatten()


def zero_headed(entry: int, hidden: int, out: int) -> nn.Sequential:
    """A two-layer MLP whose last layer starts at zero."""
    last = nn.Linear(hidden, out)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(entry, hidden), nn.ReLU(), last)
