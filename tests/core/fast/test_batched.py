"""Products with tables give what the formulas give, and the same gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from hoigs.core.device import replacement
from hoigs.core.maths.skinning import joint_transforms
from hoigs.core.maths.spherical_harmonics import irradiance_basis
from hoigs.core.maths.splines import hermite_weights

TREE = (-1, 0, 1, 0, 3, 4, 5, 3)
SEVERAL = torch.linspace(0, 1, 7, dtype=torch.float64)[:, None]


def normals() -> Tensor:
    return torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=-1)


def pose(*batch: int) -> tuple[Any, ...]:
    rotations = torch.randn(*batch, len(TREE), 3, dtype=torch.float64)
    joints = torch.randn(len(TREE), 3, dtype=torch.float64)
    return rotations, joints, TREE, torch.randn(*batch, 3, dtype=torch.float64)


def everything(function: Callable[..., Any], arguments: tuple[Any, ...], options: Any) -> Any:
    """Values, and gradients of all arguments that are tensors."""
    given = [x.clone().requires_grad_() if isinstance(x, Tensor) else x for x in arguments]
    found = function(*given, **options)
    values = torch.cat(tuple(found), -1) if isinstance(found, tuple) and found[0].dim() else found
    values = torch.stack(found) if isinstance(values, tuple) else values
    upstream = torch.arange(1, values.numel() + 1, dtype=values.dtype).view_as(values)
    sources = [x for x in given if isinstance(x, Tensor)]
    return values.detach(), *torch.autograd.grad(values, sources, upstream)


@pytest.mark.parametrize(
    ("function", "arguments", "options"),
    [
        (hermite_weights, (SEVERAL,), {}),
        (hermite_weights, (SEVERAL,), {"derivative": True}),
        (hermite_weights, (SEVERAL[2, 0],), {}),
        (hermite_weights, (SEVERAL[2, 0],), {"derivative": True}),
        (irradiance_basis, (normals(),), {}),
        (joint_transforms, pose(), {}),
        (joint_transforms, pose(2, 3), {}),
    ],
)
def test_the_table_is_the_formula(function: Any, arguments: Any, options: Any) -> None:
    fast = replacement(function, *arguments)
    assert fast is not None and fast is not function.__wrapped__
    ours = everything(fast, arguments, options)
    theirs = everything(function.__wrapped__, arguments, options)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)
