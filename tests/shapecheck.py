"""The checker that conftest's import hook applies to every annotated function."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from beartype import beartype

ARRAY = re.compile(r"\b(Tensor|ndarray|Array)\b")


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """beartype for hints that speak of tensors and arrays: shapes, dtypes, agreement of names.

    mypy sees to all other hints; some of them (Self, protocols, names imported for type checking
    only) mean nothing at run time.
    """
    function.__annotations__ = {
        name: hint if ARRAY.search(str(hint)) else Any
        for name, hint in function.__annotations__.items()
    }
    return beartype(function)
