"""Which functions of `core.maths` have faster versions in this folder, and where these apply."""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from hoigs.core.device import replace
from hoigs.core.fast import batched

# By kernels of the module named here, for float32 tensors on CPUs. Both are loaded at first use.
KERNELS = {
    "hoigs.core.maths.feature_planes.sample_planes": "planes",
    "hoigs.core.maths.nearest.point_roughness": "roughness",
    "hoigs.core.maths.rotations.turned_quats": "skin",
    "hoigs.core.maths.skinning.skin_gaussians": "skin",
}
# Likewise on CUDA.
CUDA_KERNELS = {"hoigs.core.maths.feature_planes.sample_planes": "planes_cuda"}
# By fewer operations of torch, for tensors of any kind anywhere.
BATCHED = {
    "hoigs.core.maths.skinning.joint_transforms": batched.joint_transforms,
    "hoigs.core.maths.spherical_harmonics.irradiance_basis": batched.irradiance_basis,
    "hoigs.core.maths.splines.hermite_weights": batched.hermite_weights,
}


def _by_kernel(name: str, args: tuple[Any, ...]) -> Callable[..., Any] | None:
    """The function by kernels; None, too, with a warning, where those of a CPU do not compile."""
    tensors = [x for x in args if isinstance(x, Tensor)]
    kinds = {x.device.type for x in tensors}
    single = all(x.dtype == torch.float32 or not x.is_floating_point() for x in tensors)
    module = None
    if single and kinds == {"cpu"} and name in KERNELS:
        module = _compiled(KERNELS[name])
    elif single and kinds == {"cuda"} and name in CUDA_KERNELS:
        module = importlib.import_module(f"hoigs.core.fast.{CUDA_KERNELS[name]}")
    return getattr(module, name.rpartition(".")[2], None)


@functools.cache
def _compiled(name: str) -> ModuleType | None:
    try:
        from hoigs.core.system.quiet_warp import wp

        module = importlib.import_module(f"hoigs.core.fast.{name}")
        wp.load_module(module, device="cpu")
    except Exception as error:  # Warp raises nothing narrower when a build fails
        warnings.warn(f"the CPU kernels of {name} do not compile here: {error}", stacklevel=5)
        return None
    return module


for _name in {*KERNELS, *CUDA_KERNELS}:
    replace(_name, functools.partial(_by_kernel, _name))
for _name, _function in BATCHED.items():
    replace(_name, functools.partial(lambda function, args: function, _function))
