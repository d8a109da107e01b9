"""deformation:embedded: a code for each Gaussian and a table over time (E-D3DGS, Bae et al. 2024,
arXiv:2404.03613).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.maths.feature_planes import roughness
from hoigs.core.maths.nearest import nearest
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.fields import (
    DeltaHeads,
    Head,
    Turning,
    apply_delta,
    clamped_time,
    clip_length,
    half_the_frames,
    with_residual,
)


class EmbeddedConfig(ComponentConfig):
    """E-D3DGS in its settings for single videos (arguments/hypernerf)."""

    embedding: int = Field(default=32, ge=1)
    """Width of each Gaussian's code."""
    table: int = Field(default=256, ge=1)
    """Width of the code of time."""
    rows: int | None = Field(default=100, ge=2)
    """Rows of the table, which the fine network reads in the end; None is half the clip's frames.
    """
    coarse_rows: int | None = Field(default=20, ge=2)
    """Number of rows to which the table is resampled for the coarse network, and for the fine one
    at the start; None is a fifth of `rows`."""
    fine_until: float = Field(default=0.25, ge=0, le=1)
    """Share of the run over which the fine network's rows grow from `coarse_rows`."""
    width: int = Field(default=128, ge=8)
    """Width of the layers of both networks."""
    depth: int = Field(default=0, ge=0)
    """Layers of both networks before their heads; 0 is the same as 1."""
    heads: tuple[Head, ...] = ("means", "scales", "rotations")
    """Fields of the Gaussians that the networks change."""
    table_spread: float = Field(default=0.0, ge=0)
    """Standard deviation of the table at the start, times sqrt(table); 0 is zeros."""
    anneal: float = Field(default=0.0, ge=0, le=1)
    """Share of the run over which the deltas grow to full size; 0 does not anneal."""
    turning: Turning = "composed"
    """"added" adds raw quaternions as E-D3DGS does, "composed" rotates."""
    neighbours: int = Field(default=20, ge=1)
    """Number of neighbours of each Gaussian, for the smoothness of the codes."""
    table_smoothness: Literal["neighbours", "last-row"] = "neighbours"
    """"neighbours" penalises second differences; "last-row" is E-D3DGS's code, in which an index
    makes this the distance of every row from the last one."""


class Embedded(DeformationModel):
    """Coarse plus fine offsets, each from [code of time, Gaussian's code]; no coordinates are read.

    Codes of Gaussians start at zero, so that all move alike at first. Times outside [0, 1] are
    those of the ends. E-D3DGS's learned time offset of each camera is left out: a single camera has
    none (its learning rate is 0 in those settings).

    Parameters: `embedding` [N, E], allocated in `bind`; `time_table` [rows, table].

    Args:
        num_frames: frames in the clip; needed for `rows` of None.

    Raises:
        ValueError: `coarse_rows` is more than `rows`.
    """

    Config: ClassVar = EmbeddedConfig
    input_space: Literal["canonical", "world"] = "world"
    per_gaussian = ("embedding",)
    rates: ClassVar[Mapping[str, str]] = {"embedding": "embedding"}
    regularizer_weights: ClassVar[Mapping[str, float]] = {
        "embedding_smoothness": 1.0,
        "table_smoothness": 1e-4,
        "opacity": 1e-4,
    }
    transient: ClassVar[Mapping[str, Any]] = {"_opacity": None}

    def __init__(
        self, config: EmbeddedConfig | None = None, *, num_frames: int | None = None
    ) -> None:
        super().__init__()
        self.config = config = config or EmbeddedConfig()
        rows = half_the_frames(num_frames) if config.rows is None else config.rows
        self.coarse_rows = max(2, rows // 5) if config.coarse_rows is None else config.coarse_rows
        if self.coarse_rows > rows:
            raise ValueError(f"coarse_rows is {self.coarse_rows}, more than the {rows} rows")
        spread = config.table_spread / config.table**0.5
        self.time_table = nn.Parameter(torch.randn(rows, config.table) * spread)
        self._near: tuple[Tensor, Float[Tensor, "N k"]] | None = None
        self._opacity: Tensor | None = None

    @classmethod
    def from_config(cls, config: EmbeddedConfig, context: BuildContext) -> Self:
        return cls(config, num_frames=clip_length(context))

    def bind(self, canonical: Gaussians) -> None:
        config, bands = self.config, canonical.sh.shape[1]
        codes = canonical.means.new_zeros(len(canonical), config.embedding)
        self.embedding = nn.Parameter(codes)
        self.coarse, self.fine = (
            DeltaHeads(
                config.table + config.embedding, config.width, config.depth, config.heads, bands
            )
            for _ in range(2)
        )

    @property
    def fine_rows(self) -> int:
        """Rows to which the table is resampled for the fine network at this point of the run."""
        rows, until = len(self.time_table), self.config.fine_until
        share = 1.0 if until == 0 else min(self.progress / until, 1.0)
        return int(self.coarse_rows + (rows - self.coarse_rows) * share)

    @property
    def share(self) -> float:
        """Fraction of the deltas that is applied at this point of the run."""
        anneal = self.config.anneal
        return 1.0 if anneal == 0 else min(self.progress / anneal, 1.0)

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
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        moved = canonical
        for net, rows in ((self.coarse, self.coarse_rows), (self.fine, self.fine_rows)):
            code = self.time_code(moment.time, rows).expand(len(canonical), -1)
            delta = net(torch.cat((code, self.embedding), dim=1))
            moved = apply_delta(moved, delta, turning=self.config.turning, share=self.share)
        if self.training and torch.is_grad_enabled():
            self._opacity = canonical.opacity_logits.mean().sigmoid()
            if self._near is None:
                indices, distances = nearest(canonical.means, self.config.neighbours)
                self._near = indices, distances.square().to(canonical.means)
        return with_residual(moved, residual)

    def on_topology(self, change: TopologyChange) -> None:
        super().on_topology(change)
        self._near = self._opacity = None

    def regularizers(self) -> dict[str, Tensor]:
        """E-D3DGS's penalties (train.py).

        "embedding_smoothness": mean of sqrt(w) |e_i - e_j| over the nearest neighbours, w =
        exp(-2000 d^2) with d in metres between canonical means when their number last changed.
        "opacity": the sigmoid of the mean logit. "table_smoothness": see EmbeddedConfig. The first
        two are of the last forward pass in training.
        """
        table = self.time_table
        if self.config.table_smoothness == "last-row":
            rough = (table[2:] - table[-1]).square().mean()
        else:
            rough = roughness(table, dim=0)
        penalties = {"table_smoothness": rough}
        if self._near is not None and self._near[0].numel():
            indices, squared = self._near
            apart = (self.embedding[:, None] - self.embedding[indices]).square().sum(-1)
            # the constant keeps the root's gradient finite while all codes are equal
            penalties["embedding_smoothness"] = (
                (apart * (-2000 * squared).exp() + 1e-20).sqrt().mean()
            )
        if self._opacity is not None:
            penalties["opacity"], self._opacity = self._opacity, None  # its graph is freed
        return penalties
