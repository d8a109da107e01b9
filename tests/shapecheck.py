"""The checker that conftest's import hook applies to every annotated function."""

from __future__ import annotations

import contextlib
import inspect
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
    hints = function.__annotations__
    if hints.get("return", Any) is not Any:  # jaxtyping's second pass: arguments had the first
        hints = {"return": hints["return"]}
    kept = {name: hint for name, hint in hints.items() if ARRAY.search(str(hint))}
    function.__annotations__ = {name: kept.get(name, Any) for name in function.__annotations__}
    return beartype(function) if kept else function


def only_arrays(jaxtyped: Callable[..., Any]) -> Callable[..., Any]:
    """`jaxtyping.jaxtyped`, but functions whose hints name no array stay as they are.

    There is nothing to check in them, and the wrapper costs more than many of them do.
    """

    def decorate(*args: Any, **options: Any) -> Any:
        made = jaxtyped(*args, **options)
        if args:
            return made
        return lambda it: it if inspect.isfunction(it) and not _names_array(it) else made(it)

    return decorate


def _names_array(function: Callable[..., Any]) -> bool:
    for hint in function.__annotations__.values():
        if isinstance(hint, str):
            with contextlib.suppress(Exception):  # a name imported for type checking only
                hint = eval(hint, function.__globals__)  # aliases of array types
        if ARRAY.search(str(hint)):
            return True
    return False
