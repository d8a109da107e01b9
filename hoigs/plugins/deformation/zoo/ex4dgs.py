"""deformation:ex4dgs: static Gaussians on lines, dynamic ones on keyframes
(Ex4DGS, Lee et al. 2024).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Self

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel, StepStatistics
from hoigs.core.maths.rotations import (
    conjugate_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
    slerp,
)
from hoigs.core.maths.splines import Interval, catmull_rom
from hoigs.core.parameters import Resizing
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, displaced
from hoigs.core.values.topology import AxisChange, TopologyChange

# deformation:linear-displacement: each Gaussian moves along a line, as Ex4DGS's static ones.


class LinearDisplacement(DeformationModel):
    """x(t) = x + d t, with d a parameter `displacement` [N, 3], metres over the clip, 0 at first.

    Times outside [0, 1] are held at the ends. The penalty "displacement" is the mean of
    log(|d| + 0.001) (Ex4DGS, train.py), which pulls small displacements to zero.
    """

    provides = frozenset({"velocity"})
    input_space = "world"
    per_gaussian: tuple[str, ...] = ("displacement",)
    rates: ClassVar[Mapping[str, str]] = {"displacement": "keyframes"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {"displacement": 1e-4}

    displacement: nn.Parameter

    def bind(self, canonical: Gaussians) -> None:
        self.displacement = nn.Parameter(torch.zeros_like(canonical.means))

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        means = canonical.means + self.displacement * min(max(moment.time, 0.0), 1.0)
        return canonical.replace(means=displaced(means, residual))

    def velocity(self, canonical: Gaussians, moment: Moment) -> Float[Tensor, "N 3"]:
        """Metres per unit time."""
        return self.displacement

    def regularizers(self) -> dict[str, Tensor]:
        if len(self.displacement) == 0:
            return {}
        return {"displacement": torch.log(self.displacement.norm(dim=-1) + 0.001).mean()}


# Ex4DGS's opacity over time: 1 between two centres, with a fall-off on either side.


def log_presence(
    centers: Float[Tensor, "D 2"],
    log_widths: Float[Tensor, "D 2"],
    time: float,
    floor: float,
    *,
    jump: bool,
) -> Float[Tensor, " D"]:
    """Logarithm of the factor on each opacity: 0 between the centres, falling as a Gaussian
    outside, exp(-(distance / (exp(log width) + floor))^2) (Ex4DGS, Lee et al. 2024, eq. 8).

    Args:
        centers: in either order, in the unit of `time`. log_widths: before the first centre, and
            after the second.
        jump: as the published code has it, the distance before the first centre is measured from
            the second one, so that the factor jumps to 1 at the first.
    """
    first, last = centers.amin(1), centers.amax(1)
    widths = log_widths.exp() + floor
    before, after = first - time, time - last
    early = (last - time if jump else before) / widths[:, 0]
    late = after / widths[:, 1]
    zero = torch.zeros_like(first)
    distance = torch.where(before > 0, early, torch.where(after > 0, late, zero))
    return -distance.square()


def scaled_logits(
    logits: Float[Tensor, " D"], log_factor: Float[Tensor, " D"]
) -> Float[Tensor, " D"]:
    """Logits of sigmoid(logits) * exp(log_factor), for factors of at most 1; finite throughout."""
    product = torch.nn.functional.logsigmoid(logits) + log_factor
    # log(p / (1 - p)) of p = exp(product); where the factor is 1 this is the logit itself
    capped = product.clamp(max=-1e-6)
    return torch.where(log_factor == 0, logits, capped - torch.log(-torch.expm1(capped)))


STILL = 1e-6  # metres over the clip; what moves less is never promoted
START_LOG_WIDTH = 2.0  # of new Gaussians' opacity in time, e^2 keyframe intervals
DYNAMIC = ("keyframe_means", "keyframe_quats", "centers", "log_widths")  # of dynamic rows alone


class Ex4dgsConfig(ComponentConfig):
    """Ex4DGS's motion (configs/N3V/n3v_base.json); two errors of its code are options, off by
    default."""

    interval: int = Field(default=10, ge=1)
    """Frames between keyframes."""
    pad: int = Field(default=2, ge=0)
    """Frames that keyframes reach beyond either end."""
    promote: float = Field(default=0.02, ge=0, le=1)
    """Share of the visible static Gaussians that becomes dynamic at a promotion."""
    promote_every: int = Field(default=400, ge=1)
    """Steps; None has no end."""
    promote_from: int = Field(default=500, ge=0)
    """Steps; None has no end."""
    promote_until: int | None = Field(default=None, ge=0)
    """Steps; None has no end."""
    hemisphere: bool = True
    """Slerp keyframe rotations along the shorter arc; its code does not choose."""
    opacity_jump: bool = False
    """Opacity before the first centre falls off from the second one, as in its code."""


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
        num_frames: frames in the clip.
    """

    Config: ClassVar = Ex4dgsConfig
    provides = frozenset()
    rates: ClassVar[Mapping[str, str]] = {
        **LinearDisplacement.rates,
        "keyframe_means": "keyframes",
        "keyframe_quats": "keyframe_rotation",
        "centers": "keyframe_rotation",
        "log_widths": "keyframe_rotation",
    }
    resizes: ClassVar[Mapping[str, int]] = dict.fromkeys(("rows", *DYNAMIC), 0)
    regularizer_weights: ClassVar[Mapping[str, float]] = {"displacement": 1e-4, "motion": 1e-4}

    rows: Tensor
    rest_quats: Tensor
    keyframe_means: nn.Parameter
    keyframe_quats: nn.Parameter
    centers: nn.Parameter
    log_widths: nn.Parameter

    def __init__(self, config: Ex4dgsConfig | None = None, *, num_frames: int) -> None:
        super().__init__()
        if num_frames < 1:
            raise ValueError(f"Ex4dgs needs the clip's number of frames, got {num_frames}")
        self.config = config or Ex4dgsConfig()
        self.frames = num_frames
        self.shift = self.config.pad + self.config.interval  # frames before the first
        last = (self.frames - 1 + self.shift) / self.config.interval
        self.keyframes = math.floor(last) + 3  # two knots beyond the last interval's start

    @classmethod
    def from_config(cls, config: Ex4dgsConfig, context: BuildContext) -> Self:
        if context.clip is None:
            raise ValueError("deformation:ex4dgs needs a clip, whose frames place the keyframes")
        return cls(config, num_frames=context.clip.num_frames)

    def bind(self, canonical: Gaussians) -> None:
        super().bind(canonical)
        means = canonical.means
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
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = super().forward(canonical, moment)
        if len(self.rows):
            moved = self._with_dynamic(moved, moment.time)
        return moved.replace(means=displaced(moved.means, residual))

    def _with_dynamic(self, moved: Gaussians, time: float) -> Gaussians:
        """`moved` with the dynamic rows as they are at `time`."""
        position = self.position(time)
        k = math.floor(position)
        r = position - k
        window = self.keyframe_means[:, k - 1 : k + 3]
        means = catmull_rom(window, Interval(1, r))
        pair = self.keyframe_quats[:, k : k + 2]
        turn = slerp if self.config.hemisphere else slerp_without_check
        quats = turn(pair[:, 0], pair[:, 1], r)
        logits = scaled_logits(moved.opacity_logits[self.rows], self._log_presence(position))
        return moved.replace(
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
    def evolve(self, canonical: Gaussians, statistics: StepStatistics) -> Mapping[str, AxisChange]:
        c, step = self.config, statistics.step
        until = statistics.total_steps if c.promote_until is None else c.promote_until
        if not c.promote_from <= step <= until or (step - c.promote_from) % c.promote_every:
            return {}
        distance = (canonical.means - statistics.camera.center.to(canonical.means)).square().sum(-1)
        moved = self.displacement.norm(dim=-1)
        score = moved / (distance + 1e-6)
        static = ~self.is_dynamic() & (statistics.radii > 0)
        score[~static | (moved <= STILL)] = -1.0
        count = min(round(c.promote * int(static.sum())), int((score > 0).sum()))
        if count == 0:
            return {}
        chosen = torch.sort(score, descending=True, stable=True).indices[:count]
        return self.promote(canonical, chosen.sort().values)

    @torch.no_grad()
    def promote(self, canonical: Gaussians, chosen: Int[Tensor, " P"]) -> Mapping[str, AxisChange]:
        """Make static rows dynamic, on the lines that they are on; how moments follow."""
        count, like = self.keyframes, self.keyframe_means
        knots = torch.arange(count, device=like.device, dtype=like.dtype)
        times = (knots * self.config.interval - self.shift) / max(self.frames - 1, 1)
        line = self.displacement[chosen][:, None] * times[:, None]
        # from a quarter to three quarters of the clip, with wide flanks: visible all the time
        ends = like.new_tensor([self.position(0.25), self.position(0.75)])
        fresh = {
            "keyframe_means": canonical.means[chosen][:, None] + line,
            "keyframe_quats": normalize_quats(canonical.quats[chosen])[:, None].repeat(1, count, 1),
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
        slots = self._slots(change)
        kept = slots >= 0
        return dict.fromkeys(DYNAMIC, AxisChange(0, slots[kept], change.fresh[kept]))

    def _slots(self, change: TopologyChange) -> Int[Tensor, " M"]:
        """Index among the dynamic rows of each new Gaussian's source, -1 for static ones."""
        slots = torch.full((len(self.displacement),), -1, device=self.rows.device)
        slots[self.rows] = torch.arange(len(self.rows), device=self.rows.device)
        return slots[change.source]

    @torch.no_grad()
    def on_topology(self, change: TopologyChange) -> None:
        """Rows follow; a dynamic child is displaced in every keyframe, turned as that one is."""
        slots = self._slots(change)
        kept = slots >= 0
        super().on_topology(change)
        for name in DYNAMIC:
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
        inverse = conjugate_quats(quats[:, :1]).expand_as(quats)
        turns = quats_to_matrices(multiply_quats(quats, inverse))
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
    """Slerp without the choice between q' and -q': the longer arc where their dot is negative."""
    a, b = normalize_quats(a), normalize_quats(b)
    dot = (a * b).sum(-1, keepdim=True).clamp(-1 + 1e-4, 1 - 1e-4)
    angle = torch.acos(dot)
    mixed = torch.sin((1 - r) * angle) * a + torch.sin(r * angle) * b
    vanished = mixed.abs().sum(-1, keepdim=True) <= 1e-4
    return normalize_quats(torch.where(vanished, a, mixed))
