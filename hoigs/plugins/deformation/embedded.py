"""deformation:embedded: a code per Gaussian and a table over time (E-D3DGS, Bae et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.deformation import DeformationModel
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.topology import TopologyChange
from hoigs.plugins.deformation.deltas import (
    DeltaHeads,
    Head,
    Turning,
    apply_delta,
    clamped_time,
    half_the_frames,
    nearest_squared,
    second_differences,
    with_residual,
)

TableSmoothness = Literal["neighbours", "last-row"]


class EmbeddedConfig(ComponentConfig):
    """E-D3DGS in its setting for single videos (arguments/hypernerf; methods B.3).

    Attributes:
        embedding: width of each Gaussian's code. table: width of the code of time.
        rows: of the table; what the fine network reads in the end; None is half the clip's frames.
        coarse_rows: to how many the table is resampled for the coarse network, and for the fine one
            at the start; None is a fifth of `rows`.
        fine_until: share of the run over which the fine one's rows grow from `coarse_rows`.
        width, depth: of both networks. heads: what they change.
        table_spread: standard deviation of the table at the start, times sqrt(table); 0 is zeros.
        anneal: share of the run over which the deltas grow to full size; 0 does not anneal.
        turning: "added" adds raw quaternions as E-D3DGS does, "composed" turns.
        neighbours: of each Gaussian, for the smoothness of the codes.
        table_smoothness: "neighbours" penalises second differences; "last-row" is E-D3DGS's code,
            whose index makes of that the distance of every row from the last one.
    """

    embedding: int = Field(32, ge=1)
    table: int = Field(256, ge=1)
    rows: int | None = Field(100, ge=2)
    coarse_rows: int | None = Field(20, ge=2)
    fine_until: float = Field(0.25, ge=0, le=1)
    width: int = Field(128, ge=8)
    depth: int = Field(0, ge=0)
    heads: tuple[Head, ...] = ("means", "scales", "rotations")
    table_spread: float = Field(0.0, ge=0)
    anneal: float = Field(0.0, ge=0, le=1)
    turning: Turning = "composed"
    neighbours: int = Field(20, ge=1)
    table_smoothness: TableSmoothness = "neighbours"


class Embedded(DeformationModel):
    """Coarse plus fine offsets, each from [time code, Gaussian's code]; no coordinates are read.

    Codes of Gaussians start at zero, so all move alike at first and part where images ask for it.
    Times outside [0, 1] are held at the ends. E-D3DGS's learned time offset of each camera is left
    out: one camera has none (its rate is 0 in that setting).

    Parameters: `embedding` [N, E], allocated in `bind`; `time_table` [rows, table].

    Args: as EmbeddedConfig.
    """

    rest_space: Literal["canonical", "world"] = "world"
    per_gaussian = ("embedding",)
    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "embedding_smoothness": 1.0,
        "table_smoothness": 1e-4,
        "opacity": 1e-4,
    }

    def __init__(
        self,
        embedding: int = 32,
        table: int = 256,
        rows: int = 100,
        coarse_rows: int | None = 20,
        fine_until: float = 0.25,
        width: int = 128,
        depth: int = 0,
        heads: Sequence[Head] = ("means", "scales", "rotations"),
        table_spread: float = 0.0,
        anneal: float = 0.0,
        turning: Turning = "composed",
        neighbours: int = 20,
        table_smoothness: TableSmoothness = "neighbours",
    ) -> None:
        super().__init__()
        if coarse_rows is None:
            coarse_rows = max(2, rows // 5)
        if coarse_rows > rows:
            raise ValueError(f"coarse_rows is {coarse_rows}, more than the {rows} rows there are")
        self.code_width, self.coarse_rows, self.fine_until = embedding, coarse_rows, fine_until
        self.width, self.depth, self.fields = width, depth, tuple(heads)
        self.anneal, self.turning = anneal, turning
        self.neighbours, self.smoothing = neighbours, table_smoothness
        self.time_table = nn.Parameter(torch.randn(rows, table) * (table_spread / table**0.5))
        self._near: tuple[Tensor, Float[Tensor, "N k"]] | None = None
        self._opacity: Tensor | None = None

    @classmethod
    def from_config(cls, config: EmbeddedConfig, context: BuildContext) -> Self:
        settings = config.model_dump()
        settings["rows"] = config.rows or half_the_frames(context)
        return cls(**settings)

    def bind(self, rest: Gaussians) -> None:
        self.embedding = nn.Parameter(rest.means.new_zeros(len(rest), self.code_width))
        entry, bands = self.time_table.shape[1] + self.code_width, rest.sh.shape[1]
        self.coarse, self.fine = (
            DeltaHeads(entry, self.width, self.depth, self.fields, bands) for _ in range(2)
        )

    @property
    def fine_rows(self) -> int:
        """Rows to which the table is resampled for the fine network at this point of the run."""
        rows, done = len(self.time_table), self.progress
        share = 1.0 if self.fine_until == 0 else min(done / self.fine_until, 1.0)
        return int(self.coarse_rows + (rows - self.coarse_rows) * share)

    @property
    def share(self) -> float:
        """Of the deltas that is applied at this point of the run."""
        return 1.0 if self.anneal == 0 else min(self.progress / self.anneal, 1.0)

    def time_code(self, time: float, rows: int) -> Float[Tensor, " T"]:
        """The table resampled to `rows` rows over [0, 1] and read at `time`, both linearly."""
        resampled: Tensor = self.time_table
        if rows != len(resampled):
            resampled = nn.functional.interpolate(
                resampled.mT[None], size=rows, mode="linear", align_corners=True
            )[0].mT
        place = clamped_time(time) * (rows - 1)
        k = min(int(place), rows - 2)
        return torch.lerp(resampled[k], resampled[k + 1], place - k)

    def forward(
        self, rest: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = rest
        for net, rows in ((self.coarse, self.coarse_rows), (self.fine, self.fine_rows)):
            code = self.time_code(moment.time, rows).expand(len(rest), -1)
            delta = net(torch.cat((code, self.embedding), dim=1))
            moved = apply_delta(moved, delta, turning=self.turning, share=self.share)
        if self.training and torch.is_grad_enabled():
            self._opacity = rest.opacity_logits.mean().sigmoid()
            if self._near is None:
                self._near = nearest_squared(rest.means, self.neighbours)
        return with_residual(moved, residual)

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        self._near = self._opacity = None

    def regularizers(self) -> dict[str, Tensor]:
        """E-D3DGS's penalties (train.py).

        "embedding_smoothness": mean of sqrt(w) |e_i - e_j| over the nearest neighbours, w =
        exp(-2000 d^2) with d in metres, at rest when the count last changed. "opacity": the
        sigmoid of the mean logit. "table_smoothness": see EmbeddedConfig. The first two are of the
        last forward pass in training.
        """
        table = self.time_table
        if self.smoothing == "last-row":
            rough = (table[2:] - table[-1]).square().mean()
        else:
            rough = second_differences(table)
        penalties = {"table_smoothness": rough}
        if self._near is not None and self._near[0].numel():
            indices, squared = self._near
            apart = (self.embedding[:, None] - self.embedding[indices]).square().sum(-1)
            # the constant keeps the root's gradient finite while all codes are equal
            penalties["embedding_smoothness"] = (
                (apart * (-2000 * squared).exp() + 1e-20).sqrt().mean()
            )
        if self._opacity is not None:
            penalties["opacity"], self._opacity = self._opacity, None  # the graph must not stay
        return penalties
