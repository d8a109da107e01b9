"""Comparisons whose errors name what differs, by how much and where."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from hoigs.testing.checks import CheckError


def require(condition: Any, message: str) -> None:
    """Raise CheckError with `message` unless `condition` (a bool or a tensor of one) holds."""
    if not bool(condition):
        raise CheckError(message)


def require_close(
    what: str, actual: Tensor | float, expected: Tensor | float, *, atol: float, rtol: float = 0.0
) -> None:
    """|actual - expected| <= atol + rtol |expected| everywhere, in float64; NaN never is."""
    a, b = (torch.as_tensor(x).detach().double().cpu() for x in (actual, expected))
    if a.shape != b.shape:
        raise CheckError(f"{what} has shape {list(a.shape)}, expected {list(b.shape)}")
    excess = (a - b).abs() - (atol + rtol * b.abs())
    good = excess <= 0
    if bool(good.all()):
        return
    worst = int(torch.where(good, -torch.inf, excess.nan_to_num(torch.inf)).argmax())
    place = [int(i) for i in torch.unravel_index(torch.tensor(worst), a.shape)]
    raise CheckError(
        f"{what} is {a.flatten()[worst]:.6g}, expected {b.flatten()[worst]:.6g} within "
        f"{atol:g} + {rtol:g} of it"
        + (f", at {place}; {int((~good).sum())} of {a.numel()} entries are off" if place else "")
    )


def require_zero(what: str, value: Tensor | None) -> None:
    """Every entry is exactly zero; None, an absent gradient, counts as zeros."""
    if value is not None and bool((value != 0).any()):
        place = (value != 0).nonzero()[0].tolist()
        raise CheckError(f"{what} is {float(value[tuple(place)]):g} at {place}, expected zeros")


def require_finite(what: str, value: Tensor) -> None:
    if not bool(torch.isfinite(value).all()):
        place = (~torch.isfinite(value)).nonzero()[0].tolist()
        raise CheckError(f"{what} is {float(value[tuple(place)])} at {place}, expected numbers")


def require_close_gradient(
    what: str, actual: Tensor | None, expected: Tensor, error: float
) -> None:
    """|actual - expected| <= error |expected|, as vectors."""
    if actual is None:
        raise CheckError(f"no gradient reached {what}")
    require_finite(f"gradient of {what}", actual)
    a, b = actual.double().cpu().flatten(), expected.double().cpu().flatten()
    off = float((a - b).norm() / b.norm())
    if not off <= error:
        cosine = float(a @ b / (a.norm() * b.norm()))
        raise CheckError(
            f"gradient of {what}: relative L2 error {off:.2e}, expected at most {error:g} "
            f"(cosine {cosine:.7f})"
        )
