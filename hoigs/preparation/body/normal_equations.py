"""Least squares whose unknowns are those of each frame, coupled to two frames before, and shared
ones."""

from __future__ import annotations

from copy import copy

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from torch import Tensor

REACH = 2  # frames that an acceleration couples a frame to


class NormalEquations:
    """H x = -g, with H block-banded in the frames and bordered by the shared unknowns.

    Attributes:
        blocks: of frame t with frame t + d, for d = 0, 1, 2. border: of each frame with the shared
            unknowns. shared: of these with one another. by_frame, by_shared: the gradient.
    """

    def __init__(self, frames: int, width: int, shared: int) -> None:
        double = torch.float64
        self.blocks = [
            torch.zeros(max(frames - d, 0), width, width, dtype=double) for d in range(REACH + 1)
        ]
        self.border = torch.zeros(frames, width, shared, dtype=double)
        self.shared = torch.zeros(shared, shared, dtype=double)
        self.by_frame = torch.zeros(frames, width, dtype=double)
        self.by_shared = torch.zeros(shared, dtype=double)

    def of(self, frames: slice) -> NormalEquations:
        """A view of some frames' part: what is added to it is added to these."""
        part = copy(self)
        first, last, _ = frames.indices(len(self.by_frame))
        part.blocks = [block[first : max(last - d, first)] for d, block in enumerate(self.blocks)]
        part.border, part.by_frame = self.border[first:last], self.by_frame[first:last]
        return part

    def add(
        self,
        residuals: Float[Tensor, "F R"],
        weights: Float[Tensor, "F R"],
        by_frame: Float[Tensor, "F R N"],
        by_shared: Float[Tensor, "F R S"],
    ) -> None:
        """Residuals of single frames: half the sum of weights times their squares."""
        weighted = by_frame.mT * weights[:, None]
        self.blocks[0] += weighted @ by_frame
        self.border += weighted @ by_shared
        self.by_frame += (weighted @ residuals[..., None])[..., 0]
        self._add_shared(residuals, weights, by_shared)

    def add_accelerations(
        self,
        residuals: Float[Tensor, "T R"],
        weights: Float[Tensor, "T R"],
        factors: Float[Tensor, "T 3"],
        by_frame: Float[Tensor, "F R N"],
        by_shared: Float[Tensor, "F R S"],
    ) -> None:
        """Residuals that are, of frames t, t + 1 and t + 2, a sum of values times `factors`."""
        count = len(residuals)
        parts = [by_frame[k : k + count] * factors[:, k, None, None] for k in range(3)]
        shared = torch.stack(
            [by_shared[k : k + count] * factors[:, k, None, None] for k in range(3)]
        ).sum(0)
        for a in range(3):
            weighted = parts[a].mT * weights[:, None]
            self.border[a : a + count] += weighted @ shared
            self.by_frame[a : a + count] += (weighted @ residuals[..., None])[..., 0]
            for b in range(a, 3):
                self.blocks[b - a][a : a + count] += weighted @ parts[b]
        self._add_shared(residuals, weights, shared)

    def take(self, others: NormalEquations, frames: Int[Tensor, " K"]) -> None:
        """Adds those of residuals of single frames, some of these."""
        self.blocks[0][frames] += others.blocks[0]
        self.border[frames] += others.border
        self.by_frame[frames] += others.by_frame
        self.shared += others.shared
        self.by_shared += others.by_shared

    def hold(self, frames: int) -> None:
        """Leave the unknowns of the first frames as they are."""
        self.by_frame[:frames], self.border[:frames] = 0, 0
        for block in self.blocks:
            block[:frames] = 0
        self.blocks[0][:frames] = torch.eye(self.by_frame.shape[1]).to(self.by_frame)

    def _add_shared(self, residuals: Tensor, weights: Tensor, by_shared: Tensor) -> None:
        flat = by_shared.flatten(0, 1)
        weighted = flat * weights.flatten()[:, None]
        self.shared += weighted.T @ flat
        self.by_shared += weighted.T @ residuals.flatten()

    def step(self, damping: float) -> tuple[Float[Tensor, "F N"], Float[Tensor, " S"]] | None:
        """The step to the minimum (Levenberg 1944, Marquardt 1963), of frames and shared unknowns.

        Args:
            damping: share of the diagonal that is added to it.

        Returns:
            None if the matrix is not positive definite.
        """
        frames, width = self.by_frame.shape
        band = self._band(damping)
        right = torch.cat((self.by_frame[..., None], self.border), -1).reshape(frames * width, -1)
        try:
            factor = cholesky_banded(band, overwrite_ab=True, check_finite=False)
        except LinAlgError:
            return None
        solved = torch.from_numpy(cho_solve_banded((factor, False), right.numpy()))
        border = self.border.flatten(0, 1)
        left = self.shared + torch.diag(damping * self.shared.diagonal() + 1e-9)
        left = left - border.T @ solved[:, 1:]
        down, problem = torch.linalg.solve_ex(left, border.T @ solved[:, 0] - self.by_shared)
        if int(problem) != 0:
            return None
        step = -(solved[:, 0] + solved[:, 1:] @ down).unflatten(0, (frames, width))
        return (step, down) if bool(torch.isfinite(step).all()) else None

    def _band(self, damping: float) -> Float[np.ndarray, "K M"]:
        """Upper diagonals of the frames' part, as LAPACK stores them."""
        frames, width = self.by_frame.shape
        reach = (REACH + 1) * width - 1
        band = np.zeros((reach + 1, frames * width), order="F")  # LAPACK's, or it is copied
        row, column = np.meshgrid(np.arange(width), np.arange(width), indexing="ij")
        for d, blocks in enumerate(self.blocks):
            upper = row <= column if d == 0 else np.ones_like(row, bool)
            down = (reach + row - column - d * width)[upper]
            for t, block in enumerate(blocks.numpy()):
                band[down, (column + (t + d) * width)[upper]] = block[upper]
        band[reach] *= 1 + damping
        band[reach] += 1e-9
        return band
