"""Rows chosen, and added up, by indices: the same bits every time, gradients included.

torch adds up rows of the same index in any order where it uses atomics: on CUDA `index_add`, and so
the gradient of `index_select`; on a CPU of several cores `index_put`, and so that of `x[indices]`.
"""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor


def rows_of(values: Float[Tensor, "N *rest"], indices: Int[Tensor, "*shape"]) -> Tensor:
    """values[indices]."""
    if values.is_cuda:
        return values[indices]
    return values.index_select(0, indices.flatten()).unflatten(0, indices.shape)


def added_rows(
    values: Float[Tensor, "M *rest"], indices: Int[Tensor, " M"], count: int
) -> Float[Tensor, "N *rest"]:
    """The sums of the rows with each index below `count`."""
    sums = values.new_zeros(count, *values.shape[1:])
    if values.is_cuda:
        return sums.index_put((indices,), values, accumulate=True)
    return sums.index_add(0, indices, values)
