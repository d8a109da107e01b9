"""interaction:cross-attention: the HOI module of HOIGS (Sec. "Interaction Module", Eq. 9 to 13)."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from hoigs.core.config import ComponentConfig
from hoigs.core.device import constant
from hoigs.core.interfaces.body import (
    BODY_JOINT_PARTS,
    LEFT_HAND_PART,
    PART_NAMES,
    RIGHT_HAND_PART,
)
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.parameters import zeroed
from hoigs.core.values.tokens import POSE_JOINTS, EntityKind, Residual, Role, Tokens

# The distance mask B (HOIGS, Eq. 12), and its smooth form.


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


OFFSET_UNIT = 0.1  # metres, the size of corrections
# body part of each joint that has a correction; the root has none
JOINT_PARTS = (*BODY_JOINT_PARTS[1:], *(LEFT_HAND_PART,) * 15, *(RIGHT_HAND_PART,) * 15)


class CrossAttentionConfig(DistanceGateConfig):
    """The paper's module, with a choice wherever the paper is ambiguous."""

    width: int = Field(default=32, ge=1)
    """D of queries, keys and values; the paper's 32."""
    values: Literal["gated", "swapped"] = "gated"
    """The products in Eq. 11 do not fit: softmax(Q_h K_o^T) is [16, N_o], V_h [16, d]. "swapped"
    reads A V_other, ordinary cross-attention; exchanging the two printed outputs, the third way to
    make them fit, is the same. "gated", the default, is V_self + g A V_other: it keeps the printed
    V_self, so that a token has its own features besides those of the other."""
    pose_head: Literal["flat", "per-part"] = "flat"
    """How the 16 tokens become 51 corrections is left open. "flat", the default, is one MLP of all
    of them, so that an elbow may follow from what the hand does; "per-part" reads each joint from
    the token of the part that it belongs to, gated by that part's gate."""
    object_residual: Literal["per-gaussian", "rigid", "both"] = "per-gaussian"
    """"per-gaussian" (the paper, hence the default: it can bend a rigid object), one "rigid" motion
    of the object, or "both"."""
    hidden: int = Field(default=128, ge=1)
    """Width of the hidden layer of both heads, which the paper does not give."""
    pose_bound: float = Field(default=0.3, gt=0)
    """Largest correction of a joint's axis-angle, radians per axis: large sums of axis-angles are
    no composition of rotations, and unbounded ones diverge."""
    means_bound: float = Field(default=0.1, gt=0)
    """Largest displacement of an object's Gaussian, metres per axis."""
    places: Literal["none", "hands"] = "none"
    """The geometry that the residuals depend on. "none" is the paper: tokens alone. "hands", which
    the spec hoigs sets, adds to F'_O and F'_H a linear map of where both hands are from the
    object's centre, world axes, gated like all that comes from another entity. Without it an object
    does not follow hands off its spline: phi, read in planes where a hand is, identifies that place
    only in frames that were trained on, and no token contains where the spline has put the object.
    """


class CrossAttention(InteractionModule):
    """Humans attend to the tokens of all objects, and objects to the parts of all humans.

    F'_H = V_h + g softmax(Q_h K_o^T / sqrt(d) + B) V_o, and the mirror image for objects (Eq. 11);
    one head, no normalisation and no output projection, as the paper mentions none. MLPs turn F'_H
    into the pose correction of body and hands, F'_O into displacements of the object's Gaussians
    (Eq. 13). B is the logarithm of the distance gate. A softmax ignores what all entries of a row
    share, so the gate g (the largest of a row) also multiplies every residual: what is out of reach
    has a residual of zero, whose gradients are zero too. Gates have no gradient.

    With `places` "hands" both get + sum over the others of g (W d + b), d from `hand_offsets`.

    Both heads start at zero. Entities of one kind with tokens of one width share their weights.
    Object tokens are one for each Gaussian, human tokens one for each body part.
    """

    Config: ClassVar = CrossAttentionConfig
    cuda_graph_safe = True
    tokens = MappingProxyType({"human": "part", "object": "gaussian"})

    def __init__(self, config: CrossAttentionConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or CrossAttentionConfig()
        width, hidden = config.width, config.hidden
        self.projections = nn.ModuleDict()
        flat = config.pose_head == "flat"
        entry = len(PART_NAMES) * width if flat else width
        self.pose_head = _head(entry, hidden, 3 * POSE_JOINTS)
        if config.object_residual != "rigid":
            self.means_head = _head(width, hidden, 3)
        if config.object_residual != "per-gaussian":
            self.twist_head = _head(width, hidden, 6)
        self.places = nn.ModuleDict()
        if config.places == "hands":
            self.places["human"] = nn.Linear(6, width)
            self.places["object"] = nn.Linear(6, width)

    def bind(self, widths: Mapping[str, int], kinds: Mapping[str, EntityKind]) -> None:
        for name, width in widths.items():
            key = f"{kinds[name]}_{width}"
            if kinds[name] != "scene" and key not in self.projections:
                self.projections[key] = nn.Linear(width, 3 * self.config.width, bias=False)

    def forward(
        self, tokens: Mapping[str, Tokens], roles: Mapping[str, Role]
    ) -> Mapping[str, Residual]:
        humans = [name for name in tokens if roles[name].kind == "human"]
        objects = [name for name in tokens if roles[name].kind == "object"]
        if not humans or not objects:
            return {}
        for name in humans:
            if len(tokens[name].features) != len(PART_NAMES):
                raise ValueError(
                    f'"{name}" has {len(tokens[name].features)} tokens; a human needs '
                    f"{len(PART_NAMES)}, one for each body part: take features:body-parts, or "
                    "leave its features out (features: null)"
                )
        projected = {n: self._project(roles[n].kind, tokens[n]) for n in humans + objects}
        log_gates = {
            (h, o): log_gate(self.config, h, roles[h], tokens[h], tokens[o])
            for h in humans
            for o in objects
        }
        placed = [o for o in objects if len(tokens[o].positions)]
        offsets = {(h, o): hand_offsets(tokens[h], tokens[o]) for h in humans for o in placed}
        residuals = {}
        for h in humans:
            bias = torch.cat([log_gates[h, o] for o in objects], dim=1)
            attended, gates = self._attend(projected[h], [projected[o] for o in objects], bias)
            pairs = [(offsets[h, o], log_gates[h, o].amax(1)) for o in placed]
            attended = self._placed("human", attended, pairs)
            residuals[h] = Residual(pose=self._pose(attended, gates))
        for o in objects:
            bias = torch.cat([log_gates[h, o].mT for h in humans], dim=1)
            attended, gates = self._attend(projected[o], [projected[h] for h in humans], bias)
            pairs = [(offsets[h, o], log_gates[h, o].amax(0)) for h in humans if o in placed]
            attended = self._placed("object", attended, pairs)
            means = self._means(attended, gates, tokens[o].positions.detach())
            residuals[o] = Residual(means=means)
        return residuals

    def _project(self, kind: EntityKind, tokens: Tokens) -> Float[Tensor, "M QKV"]:
        """Queries, keys and values of one entity (Eq. 9, 10), concatenated."""
        return self.projections[f"{kind}_{tokens.features.shape[1]}"](tokens.features)

    def _attend(
        self,
        own: Float[Tensor, "M QKV"],
        others: list[Tensor],
        bias: Float[Tensor, "M N"],
    ) -> tuple[Float[Tensor, "M d"], Float[Tensor, " M"]]:
        """F' of one entity's tokens (Eq. 11), and the gate of each."""
        query, _, value = own.chunk(3, dim=-1)
        _, keys, values = torch.cat(others).chunk(3, dim=-1)
        gates = bias.amax(1).exp()
        # a row that is closed everywhere would be NaN; its gate is zero, so its weights are unused
        bias = torch.where(torch.isneginf(bias).all(1, keepdim=True), 0.0, bias)
        weights = (query @ keys.mT / self.config.width**0.5 + bias).softmax(-1)
        attended = gates[:, None] * (weights @ values)
        return (value + attended if self.config.values == "gated" else attended), gates

    def _placed(
        self,
        kind: EntityKind,
        attended: Float[Tensor, "M d"],
        pairs: list[tuple[Tensor, Tensor]],
    ) -> Float[Tensor, "M d"]:
        """F' plus what `places` adds.

        Args:
            pairs: offsets [6] and logarithms of the gates [M] for each entity of the other kind.
        """
        if kind not in self.places or not pairs:
            return attended
        added = [log[:, None].exp() * self.places[kind](offset) for offset, log in pairs]
        return attended + torch.stack(added).sum(0)

    def _pose(
        self, attended: Float[Tensor, "M d"], gates: Float[Tensor, " M"]
    ) -> Float[Tensor, "51 3"]:
        """Delta theta, bounded and gated (Eq. 13): of all tokens, or of each joint's own part."""
        bound = self.config.pose_bound
        if self.config.pose_head == "per-part":
            parts = constant(JOINT_PARTS, attended, torch.long)
            every = self.pose_head(attended).unflatten(1, (POSE_JOINTS, 3))
            raw = every[parts, torch.arange(POSE_JOINTS, device=parts.device)]
            return gates[parts, None] * bound * torch.tanh(raw)
        raw = self.pose_head(attended.flatten()).unflatten(0, (POSE_JOINTS, 3))
        return gates.max() * bound * torch.tanh(raw)

    def _means(
        self,
        attended: Float[Tensor, "N d"],
        gates: Float[Tensor, " N"],
        positions: Float[Tensor, "N 3"],
    ) -> Float[Tensor, "N 3"]:
        """Delta G (Eq. 13): free for each Gaussian, or one small motion of the whole object."""
        config, means = self.config, torch.zeros_like(positions)
        if config.object_residual != "rigid":
            raw = self.means_head(attended)
            means = means + gates[:, None] * config.means_bound * torch.tanh(raw)
        if config.object_residual != "per-gaussian":
            twist = torch.tanh(self.twist_head(attended.mean(0))) * gates.max()
            turn = axis_angle_to_matrices(config.pose_bound * twist[:3])
            arms = positions - positions.mean(0)
            means = means + arms @ turn.mT - arms + config.means_bound * twist[3:]
        return means


def hand_offsets(human: Tokens, item: Tokens) -> Float[Tensor, "6"]:
    """Both hands of a human from the centre of an object, world axes, in OFFSET_UNIT."""
    hands = human.positions[LEFT_HAND_PART : RIGHT_HAND_PART + 1].detach()
    return ((hands - item.positions.detach().mean(0)) / OFFSET_UNIT).flatten()


def _head(entry: int, hidden: int, out: int) -> nn.Sequential:
    """A two-layer MLP whose last layer starts at zero."""
    last = zeroed(nn.Linear(hidden, out))
    return nn.Sequential(nn.Linear(entry, hidden), nn.ReLU(), last)
