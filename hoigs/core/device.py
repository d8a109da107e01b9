"""What keeps mathematics free of devices: times and constants that stay there, faster versions."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

# Times that may be 0-d tensors, and constants that stay on the device.
#
# A moment's time is usually a Python number. A captured CUDA graph would repeat that number at
# every replay, so graphs get the time as a 0-d tensor on the device, which is overwritten before
# each replay. Functions that take a `Time` accept both and never copy a tensor back to the host.

Time = float | Float[Tensor, ""]


def filled(like: Float[Tensor, "..."], shape: tuple[int, ...], time: Time) -> Float[Tensor, "..."]:
    """A tensor of `shape`, with the dtype and device of `like`, filled with `time`."""
    if isinstance(time, Tensor):
        return time.to(like.dtype).expand(shape)
    return like.new_full(shape, time)


def constant(values: Any, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """A cached tensor of (nested) tuples of numbers on the device of `like`; never write to it.

    A fresh tensor would be copied from the host, which waits for all work queued on the device.

    Args:
        dtype: that of `like` by default.
    """
    return _constant(values, like.dtype if dtype is None else dtype, like.device)


@functools.cache  # never freed: captured graphs go on reading these tensors
def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


# Faster versions of functions.
#
# `core.maths` has each function as the formula says. `core.fast` has faster versions of some of
# them, which do the same where they apply: it registers them by `replace` when it is loaded, at the
# first call of any such function. Mathematics names none of them.

P = ParamSpec("P")
R = TypeVar("R")
Chooser = Callable[[tuple[Any, ...]], Callable[..., Any] | None]
_choosers: dict[str, Chooser] = {}


def replaceable(function: Callable[P, R]) -> Callable[P, R]:
    """A decorator: a faster version takes the calls of this function to which it applies.

    The function itself remains as `__wrapped__`, for comparisons.
    """
    name = f"{function.__module__}.{function.__qualname__}"

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        fast = _replacement(name, (*args, *kwargs.values()))
        if fast is not None:
            found = fast(*args, **kwargs)
            if found is not NotImplemented:
                result: R = found
                return result
        return function(*args, **kwargs)

    return call


def replace(name: str, choose: Chooser) -> None:
    """Register the faster version of a function of `core.maths`.

    Args:
        name: dotted, of the function.
        choose: from the arguments of a call to the faster version, which has the same parameters;
            None where it does not apply. The version may still answer NotImplemented.
    """
    _choosers[name] = choose


def replacement(function: Callable[..., Any], *args: Any) -> Callable[..., Any] | None:
    """The faster version of a function that is asked first in a call with these arguments."""
    return _replacement(f"{function.__module__}.{function.__qualname__}", args)


def _replacement(name: str, args: tuple[Any, ...]) -> Callable[..., Any] | None:
    if not _choosers:
        importlib.import_module("hoigs.core.fast.choose")
    choose = _choosers.get(name)
    return None if choose is None else choose(args)
