# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The roughness of values over neighbours: one kernel for each pass."""

from typing import Any

import torch
from torch import Tensor

from hoigs.core.fast.launch import CPU_FLAGS, shared
from hoigs.core.first_order import IN_TORCH, first_order
from hoigs.core.system.quiet_warp import wp

# The roughness of values over neighbours on CPUs.
#
# Casts are written (float)(x), since `float(x)` is a macro of Warp.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
F32 = wp.array(dtype=wp.float32)
F64 = wp.array(dtype=wp.float64)
I32 = wp.array(dtype=wp.int32)
I64 = wp.array(dtype=wp.int64)
FORWARD = r"""
    if (__atomic_fetch_add((int*)counter.data, 1, __ATOMIC_RELAXED)) return;
    const float* values_ = (const float*)values.data;
    const long long* neighbours_ = (const long long*)neighbours.data;
    float* apart_ = (float*)apart.data;
    double sum = 0.0;
    for (int i = 0; i < count; ++i, neighbours_ += many)
        for (int c = 0; c < channels; ++c) {
            float near = 0.0f;
            for (int k = 0; k < many; ++k) near += values_[neighbours_[k] * channels + c];
            const float difference = values_[i * channels + c] - near / (float)many;
            apart_[i * channels + c] = difference;
            sum += (double)difference * (double)difference;
        }
    *(double*)total.data = sum;
"""
BACKWARD = r"""
    if (__atomic_fetch_add((int*)counter.data, 1, __ATOMIC_RELAXED)) return;
    const float* apart_ = (const float*)apart.data;
    const long long* neighbours_ = (const long long*)neighbours.data;
    float* gradient_ = (float*)gradient.data;
    const float factor = *(const float*)scale.data;
    for (int i = 0; i < count; ++i, neighbours_ += many)
        for (int c = 0; c < channels; ++c) {
            const float v = factor * apart_[i * channels + c];
            gradient_[i * channels + c] += v;
            for (int k = 0; k < many; ++k)
                gradient_[neighbours_[k] * channels + c] -= v / (float)many;
        }
"""


@wp.func_native(FORWARD)
def forward_native(
    counter: I32, count: int, channels: int, many: int, values: F32, neighbours: I64, apart: F32,
    total: F64,
): ...  # fmt: skip


@wp.kernel
def apart_from_neighbours(
    counter: I32,  # [1], zero
    count: int, channels: int,
    many: int,  # neighbours of each
    values: F32,  # [count, channels]
    neighbours: I64,  # [count, many]
    apart: F32,  # [count, channels]: each value less the mean of its neighbours'
    total: F64,  # [1]: the sum of its squares
):  # fmt: skip
    forward_native(counter, count, channels, many, values, neighbours, apart, total)


@wp.func_native(BACKWARD)
def backward_native(
    counter: I32, count: int, channels: int, many: int, apart: F32, neighbours: I64, scale: F32,
    gradient: F32,
): ...  # fmt: skip


@wp.kernel
def apart_adjoint(
    counter: I32, count: int, channels: int, many: int, apart: F32, neighbours: I64,
    scale: F32,  # [1]: of the gradient of `apart`
    gradient: F32,  # [count, channels], zero
):  # fmt: skip
    backward_native(counter, count, channels, many, apart, neighbours, scale, gradient)


def point_roughness(values: Tensor, neighbours: Tensor) -> Tensor:
    """As `nearest.point_roughness`."""
    return Roughness.apply(values, neighbours)


class Roughness(torch.autograd.Function):
    """Mean over rows of |x_i - mean of its neighbours' x|^2, of float32 rows on a CPU."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, neighbours: Tensor) -> Tensor:
        values, neighbours = values.contiguous(), neighbours.contiguous()
        apart, total = torch.empty_like(values), values.new_empty(1, dtype=torch.float64)
        sizes = [*values.shape, neighbours.shape[1]]
        shared(apart_from_neighbours, 1, [*sizes, values, neighbours, apart, total])
        ctx.save_for_backward(apart, neighbours)
        return (total[0] / len(values)).to(values.dtype)

    @staticmethod
    @first_order("the CPU kernel of roughness", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        apart, neighbours = ctx.saved_tensors
        gradient, scale = torch.zeros_like(apart), (2 / len(apart) * upstream).view(1)
        sizes = [*apart.shape, neighbours.shape[1]]
        shared(apart_adjoint, 1, [*sizes, apart, neighbours, scale, gradient])
        return gradient, None
