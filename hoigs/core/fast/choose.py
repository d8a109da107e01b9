"""Whether a computation can run by the kernels of this folder."""

from __future__ import annotations

import functools
import importlib
import warnings
from types import ModuleType

import torch
from torch import Tensor


def native(name: str, *tensors: Tensor) -> ModuleType | None:
    """The functions of `name`, a module beside this, for float32 tensors on a CPU; else None.

    None, too, with a warning, where its kernels do not compile: torch operations then do the same
    more slowly.
    """
    if all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors):
        return _compiled(name)
    return None


@functools.cache
def _compiled(name: str) -> ModuleType | None:
    try:
        from hoigs.core.system.quiet_warp import wp

        module = importlib.import_module(f"hoigs.core.fast.{name}")
        wp.load_module(module, device="cpu")
    except Exception as error:  # Warp raises nothing narrower when a build fails
        warnings.warn(f"the CPU kernels of {name} do not compile here: {error}", stacklevel=3)
        return None
    return module
