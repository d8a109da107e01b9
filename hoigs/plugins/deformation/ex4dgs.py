"""deformation:ex4dgs: static Gaussians on lines, dynamic ones on keyframes (methods B.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn

from hoigs.core import spline
from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import StepEvidence
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rotation import multiply_quats, normalize_quats, quats_to_matrices, slerp
from hoigs.core.topology import AxisChange, TopologyChange
from hoigs.plugins.deformation.linear_displacement import LinearDisplacement
from hoigs.plugins.deformation.resizing import Resizing
from hoigs.plugins.deformation.temporal_opacity import log_presence, scaled_logits

STILL = 1e-6  # metres over the clip; what moves less is never promoted
START_LOG_WIDTH = 2.0  # of new Gaussians' opacity in time, e^2 keyframe intervals


class Ex4dgsConfig(ComponentConfig):
    """Ex4DGS's motion (configs/N3V/n3v_base.json; its two slips are options, off by default).

    Attributes:
        interval: frames between keyframes. pad: frames that keyframes reach beyond either end.
        promote: share of the visible static Gaussians that becomes dynamic at a promotion.
        promote_every, promote_from, promote_until: steps; None has no end.
        hemisphere: slerp keyframe rotations the short way round; its code does not look.
        opacity_jump: opacity before the first centre falls from the second one, as in its code.
    """

    interval: int = Field(10, ge=1)
    pad: int = Field(2, ge=0)
    promote: float = Field(0.02, ge=0, le=1)
    promote_every: int = Field(400, ge=1)
    promote_from: int = Field(500, ge=0)
    promote_until: int | None = Field(None, ge=0)
    hemisphere: bool = True
    opacity_jump: bool = False


class Ex4dgs(Resizing, LinearDisplacement):
    """The whole scene as two sets. All Gaussians start static: on lines, as LinearDisplacement.

    On schedule the share `promote` of those drawn, the ones with the largest |d| / distance^2 to
    the camera (its extract_dynamic_points_from_static), become dynamic: keyframed means with
    central differences for tangents, slerped keyframed rotations, and an opacity that is 1 between
    two centres in time and falls off outside. They start on the lines that they were on.

    Times outside [0, 1] are held. Its clip grows frame by frame while it is trained; here all
    frames are there from the start.

    Parameters: `displacement` [N, 3]; of the D dynamic ones, whose rows are the buffer `rows`,
    `keyframe_means` [D, K, 3], `keyframe_quats` [D, K, 4], and `centers` and `log_widths` [D, 2]
    of opacity in time, in keyframe intervals.

    Args:
        num_frames: of the clip. Others: as Ex4dgsConfig.
    """

    provides = frozenset()
    rates: ClassVar[Mapping[str, str]] = {
        **LinearDisplacement.rates,
        "keyframe_means": "keyframes",
        "keyframe_quats": "keyframe_rotation",
        "centers": "keyframe_rotation",
        "log_widths": "keyframe_rotation",
    }
    resizes: ClassVar[Mapping[str, int]] = {
        "rows": 0, "keyframe_means": 0, "keyframe_quats": 0, "centers": 0, "log_widths": 0,
    }  # fmt: skip
    regularizer_weights: ClassVar[Mapping[str, float]] = {"displacement": 1e-4, "motion": 1e-4}

    rows: Tensor
    rest_quats: Tensor
    keyframe_means: nn.Parameter
    keyframe_quats: nn.Parameter
    centers: nn.Parameter
    log_widths: nn.Parameter

    def __init__(self, num_frames: int, **settings: Any) -> None:
        super().__init__()
        if num_frames < 1:
            raise ValueError(f"Ex4dgs needs the clip's number of frames, got {num_frames}")
        self.config = Ex4dgsConfig(**settings)
        self.frames = num_frames
        self.shift = self.config.pad + self.config.interval  # frames before the first
        last = (self.frames - 1 + self.shift) / self.config.interval
        self.keyframes = math.floor(last) + 3  # two knots beyond the last interval's start

    @classmethod
    def from_config(cls, config: Ex4dgsConfig, context: BuildContext) -> Self:
        if context.clip is None:
            raise ValueError("deformation:ex4dgs needs a clip, whose frames place the keyframes")
        return cls(context.clip.num_frames, **config.model_dump())

    def bind(self, rest: Gaussians) -> None:
        super().bind(rest)
        means = rest.means
        self.register_buffer("rows", torch.zeros(0, dtype=torch.int64, device=means.device))
        self.keyframe_means = nn.Parameter(means.new_zeros(0, self.keyframes, 3))
        self.keyframe_quats = nn.Parameter(means.new_zeros(0, self.keyframes, 4))
        self.centers = nn.Parameter(means.new_zeros(0, 2))
        self.log_widths = nn.Parameter(means.new_zeros(0, 2))

    def position(self, time: float) -> float:
        """`time` in keyframe intervals from the first knot."""
        frame = min(max(time, 0.0), 1.0) * (self.frames - 1)
        return (frame + self.shift) / self.config.interval

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = super().forward(rest, moment)
        if len(self.rows):
            moved = self._with_dynamic(moved, moment.time)
        if residual is not None and residual.means is not None:
            moved = replace(moved, means=moved.means + residual.means)
        return moved

    def _with_dynamic(self, moved: Gaussians, time: float) -> Gaussians:
        """`moved` with the dynamic rows in their place at `time`."""
        position = self.position(time)
        k = math.floor(position)
        r = position - k
        window = self.keyframe_means[:, k - 1 : k + 3]
        means = spline.catmull_rom(window, (1 + r) / 3)
        pair = self.keyframe_quats[:, k : k + 2]
        turn = slerp if self.config.hemisphere else slerp_without_check
        quats = turn(pair[:, 0], pair[:, 1], r)
        logits = scaled_logits(moved.opacity_logits[self.rows], self._log_presence(position))
        return replace(
            moved,
            means=moved.means.index_copy(0, self.rows, means),
            quats=moved.quats.index_copy(0, self.rows, quats),
            opacity_logits=moved.opacity_logits.index_copy(0, self.rows, logits),
        )

    def _log_presence(self, position: float) -> Float[Tensor, " D"]:
        floor = self.config.pad / self.config.interval / 2.36
        jump = self.config.opacity_jump
        return log_presence(self.centers, self.log_widths, position, floor, jump=jump)

    def is_dynamic(self) -> Bool[Tensor, " N"]:
        mask = torch.zeros(len(self.displacement), dtype=torch.bool, device=self.rows.device)
        mask[self.rows] = True
        return mask

    @torch.no_grad()
    def evolve(self, rest: Gaussians, evidence: StepEvidence) -> Mapping[str, AxisChange]:
        c, step = self.config, evidence.step
        until = evidence.total_steps if c.promote_until is None else c.promote_until
        if not c.promote_from <= step <= until or (step - c.promote_from) % c.promote_every:
            return {}
        distance = (rest.means - evidence.camera.center.to(rest.means)).square().sum(-1)
        moved = self.displacement.norm(dim=-1)
        score = moved / (distance + 1e-6)
        static = ~self.is_dynamic() & (evidence.radii > 0)
        score[~static | (moved <= STILL)] = -1.0
        count = min(round(c.promote * int(static.sum())), int((score > 0).sum()))
        if count == 0:
            return {}
        chosen = torch.sort(score, descending=True, stable=True).indices[:count]
        return self.promote(rest, chosen.sort().values)

    @torch.no_grad()
    def promote(self, rest: Gaussians, chosen: Int[Tensor, " P"]) -> Mapping[str, AxisChange]:
        """Make static rows dynamic, on the lines that they are on; how moments follow."""
        count, like = self.keyframes, self.keyframe_means
        knots = torch.arange(count, device=like.device, dtype=like.dtype)
        times = (knots * self.config.interval - self.shift) / max(self.frames - 1, 1)
        line = self.displacement[chosen][:, None] * times[:, None]
        # from a quarter to three quarters of the clip, with wide flanks: there all the time
        ends = like.new_tensor([self.position(0.25), self.position(0.75)])
        fresh = {
            "keyframe_means": rest.means[chosen][:, None] + line,
            "keyframe_quats": normalize_quats(rest.quats[chosen])[:, None].repeat(1, count, 1),
            "centers": ends.repeat(len(chosen), 1),
            "log_widths": like.new_full((len(chosen), 2), START_LOG_WIDTH),
        }
        rows = torch.cat((self.rows, chosen))
        order = torch.argsort(rows)
        for name, values in fresh.items():
            parameter = self.get_parameter(name)
            parameter.grad = None
            parameter.data = torch.cat((parameter.data, values))[order].contiguous()
        change = AxisChange(0, order, order >= len(self.rows))
        self.rows = rows[order]
        return dict.fromkeys(fresh, change)

    def axis_changes(self, change: TopologyChange) -> Mapping[str, AxisChange]:
        names = ("keyframe_means", "keyframe_quats", "centers", "log_widths")
        slots = self._slots(change)
        kept = slots >= 0
        return dict.fromkeys(names, AxisChange(0, slots[kept], change.fresh[kept]))

    def _slots(self, change: TopologyChange) -> Int[Tensor, " M"]:
        """Place among the dynamic rows of each new Gaussian's source, -1 for static ones."""
        slots = torch.full((len(self.displacement),), -1, device=self.rows.device)
        slots[self.rows] = torch.arange(len(self.rows), device=self.rows.device)
        return slots[change.source]

    @torch.no_grad()
    def on_topology(self, change: TopologyChange) -> None:
        """Rows follow; a dynamic child is displaced in every keyframe, turned as that one is."""
        slots = self._slots(change)
        kept = slots >= 0
        super().on_topology(change)
        for name in ("keyframe_means", "keyframe_quats", "centers", "log_widths"):
            parameter = self.get_parameter(name)
            parameter.grad = None
            parameter.data = parameter.data[slots[kept]].contiguous()
        self.rows = kept.nonzero().squeeze(1)
        offsets = change.offsets[kept].to(self.keyframe_means)
        if offsets.any():
            self.keyframe_means.data += self._turned(offsets)

    def _turned(self, offsets: Float[Tensor, "D 3"]) -> Float[Tensor, "D K 3"]:
        """Offsets in every keyframe, turned as the Gaussian has turned since the first one."""
        quats = normalize_quats(self.keyframe_quats.data)
        first = quats[:, :1] * quats.new_tensor((1.0, -1.0, -1.0, -1.0))
        turns = quats_to_matrices(multiply_quats(quats, first.expand_as(quats)))
        return torch.einsum("nkij,nj->nki", turns, offsets)

    def regularizers(self) -> dict[str, Tensor]:
        """As LinearDisplacement; "motion": mean distance of keyframes from the first, metres."""
        penalties = super().regularizers()
        if len(self.rows):
            away = self.keyframe_means[:, 1:] - self.keyframe_means[:, :1]
            penalties["motion"] = away.norm(dim=-1).mean()
        return penalties


def slerp_without_check(
    a: Float[Tensor, "D 4"], b: Float[Tensor, "D 4"], r: float
) -> Float[Tensor, "D 4"]:
    """Slerp that takes the arc from q to -q' as it comes: the long way round, if need be."""
    a, b = normalize_quats(a), normalize_quats(b)
    dot = (a * b).sum(-1, keepdim=True).clamp(-1 + 1e-4, 1 - 1e-4)
    angle = torch.acos(dot)
    mixed = torch.sin((1 - r) * angle) * a + torch.sin(r * angle) * b
    vanished = mixed.abs().sum(-1, keepdim=True) <= 1e-4
    return normalize_quats(torch.where(vanished, a, mixed))
