"""Backward passes of kernels, which have first derivatives only, and say so.

`torch.autograd.function.once_differentiable` is silent where the upstream gradient needs no
gradient: the gradients of `loss = render(x).sum()` are then constants to torch, and a gradient
penalty (`create_graph=True`) would lose its second derivatives without a word.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import DerivativeError

Backward = Callable[..., Any]
IN_TORCH = "on float64 tensors torch does the same, and has the second, too"


def first_order(name: str, instead: str) -> Callable[[Backward], Backward]:
    """A decorator of the `backward` of an autograd function, which runs it without gradients.

    Where a graph of the gradients is made all the same, the second derivative is a DerivativeError.

    Args:
        name: who has no second derivatives. instead: what has.
    """
    message = (
        f"{name} has first derivatives only, and the gradient of its gradient was asked for "
        f"(create_graph=True, as for a gradient penalty); {instead}"
    )

    def decorate(backward: Backward) -> Backward:
        @functools.wraps(backward)
        def run(ctx: Any, *upstream: Tensor | None) -> Any:
            with torch.no_grad():
                found = backward(ctx, *upstream)
            if not torch.is_grad_enabled():
                return found
            many = isinstance(found, tuple)
            gradients = found if many else (found,)
            # what the gradients depend on, so that one of these leads to the error; the new leaf
            # stands for all that the function did not save
            sources = [x for x in (*upstream, *ctx.saved_tensors) if isinstance(x, Tensor)]
            leaf = torch.zeros((), requires_grad=True)
            given = [x for x in gradients if x is not None]
            guarded = iter(_Refused.apply(message, len(given), *given, *sources, leaf))
            result = tuple(None if x is None else next(guarded) for x in gradients)
            return result if many else result[0]

        return run

    return decorate


class _Refused(torch.autograd.Function):
    """The first `count` tensors; the gradient of them is refused."""

    @staticmethod
    def forward(ctx: Any, message: str, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.message = message
        return tuple(x.view_as(x) for x in tensors[:count])

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Any:
        del upstream
        raise DerivativeError(ctx.message)
