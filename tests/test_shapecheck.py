"""What the import hook of conftest applies: shapes are checked, once, where there are any."""

from __future__ import annotations

from dataclasses import dataclass

import jaxtyping
import pytest
import shapecheck
import torch
from jaxtyping import Float, TypeCheckError
from torch import Tensor

Rows = Float[Tensor, "n 4"]
checked = jaxtyping.jaxtyped(typechecker=shapecheck.check)


@checked
def second(a: Float[Tensor, "n 4"], b: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    return b


@checked
def five(a: Float[Tensor, "n 4"]) -> Float[Tensor, " n"]:
    return torch.zeros(5)


@checked
def rows(a: Rows) -> int:
    return len(a)


@checked
def zeros(n: int) -> Float[Tensor, "3"]:
    return torch.zeros(n)


@checked
@dataclass
class Point:
    x: Float[Tensor, "3"]


@pytest.mark.parametrize(
    ("function", "right", "wrong"),
    [
        (second, [(3, 4), (3,)], [(3, 4), (4,)]),
        (second, [(3, 4), (3,)], [(3, 5), (3,)]),
        (five, [(5, 4)], [(3, 4)]),
        (rows, [(3, 4)], [(3, 5)]),
        (Point, [(3,)], [(2,)]),
    ],
)
def test_wrong_shapes_are_refused(function, right, wrong):
    function(*map(torch.zeros, right))
    with pytest.raises(TypeCheckError):
        function(*map(torch.zeros, wrong))


def test_a_result_is_checked_though_no_argument_is_an_array():
    assert len(zeros(3)) == 3
    with pytest.raises(TypeCheckError):
        zeros(2)


def test_functions_without_arrays_are_left_alone():
    def plain(n: int) -> int:
        return n

    assert checked(plain) is plain
