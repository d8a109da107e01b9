# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Bilinear samples of feature planes on CUDA: a kernel forward, and two backward."""

from typing import Any

import torch
from torch import Tensor

from hoigs.core.fast.cuda_launch import CudaStreams
from hoigs.core.fast.launch import CPU_FLAGS, prepared
from hoigs.core.fast.planes import AXIS
from hoigs.core.first_order import IN_TORCH, first_order
from hoigs.core.system.quiet_warp import wp

# C++ of the kernels, which a CPU runs too, for tests. Casts are written (float)(x), since
# `float(x)` is a macro of Warp. The arguments are described in the kernels.
#
# Threads add to the gradient of a plane in any order. The numbers that they add are whole, `unit`
# for the largest upstream gradient, so the sum is the same in every run.

_CELL = r"""
    struct Cell {
        long long first;  // the corner's first channel
        float fx, fy, slope_x, slope_y;
    };
    // on a plane that is one cell wide or high, the neighbour is the cell itself
    const long long right = width > 1 ? channels : 0;
    const long long below = height > 1 ? (long long)width * channels : 0;
$AXIS    auto cell_of = [&](int plane, int point) -> Cell {
        const float* at = (const float*)points.data + 2 * ((long long)plane * count + point);
        Cell cell;
        const int x = axis(at[0], width, cell.fx, cell.slope_x);
        const int y = axis(at[1], height, cell.fy, cell.slope_y);
        cell.first = (((long long)plane * height + y) * width + x) * channels;
        return cell;
    };
""".replace("$AXIS", AXIS.replace("$FLOOR", "floorf"))
_FORWARD = r"""
    const int channel = item % channels, plane = item / channels % many;
    const Cell cell = cell_of(plane, item / channels / many);
    const float* row = (const float*)planes.data + cell.first + channel;
    ((float*)out.data)[item] = (1.0f - cell.fy) * ((1.0f - cell.fx) * row[0] + cell.fx * row[right])
        + cell.fy * ((1.0f - cell.fx) * row[below] + cell.fx * row[below + right]);
"""
_TO_PLANES = r"""
    const int channel = item % channels, plane = item / channels % many;
    const Cell cell = cell_of(plane, item / channels / many);
    const double v = (double)((const float*)upstream.data)[item]
        * (unit / (double)((const float*)largest.data)[0]);
    long long* row = (long long*)sums.data + cell.first + channel;
    auto add = [&](long long* into, float weight) {
        const long long whole = (long long)rint(v * (double)weight);
        if (whole == 0) return;
    #if defined(__CUDA_ARCH__)
        atomicAdd((unsigned long long*)into, (unsigned long long)whole);
    #else
        *into += whole;
    #endif
    };
    add(row, (1.0f - cell.fy) * (1.0f - cell.fx));
    add(row + right, (1.0f - cell.fy) * cell.fx);
    add(row + below, cell.fy * (1.0f - cell.fx));
    add(row + below + right, cell.fy * cell.fx);
"""
_TO_POINTS = r"""
    const int plane = item % many, point = item / many;
    const Cell cell = cell_of(plane, point);
    const float* row = (const float*)planes.data + cell.first;
    const float* up = (const float*)upstream.data + (long long)item * channels;
    float x = 0.0f, y = 0.0f;
    for (int c = 0; c < channels; ++c) {
        const float v00 = row[c], v01 = row[right + c];
        const float v10 = row[below + c], v11 = row[below + right + c];
        x += up[c] * ((v01 - v00) * (1.0f - cell.fy) + (v11 - v10) * cell.fy);
        y += up[c] * ((v10 - v00) * (1.0f - cell.fx) + (v11 - v01) * cell.fx);
    }
    float* gradient = (float*)to_points.data + 2 * ((long long)plane * count + point);
    gradient[0] = x * cell.slope_x;
    gradient[1] = y * cell.slope_y;
"""

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
F32 = wp.array(dtype=wp.float32)
I64 = wp.array(dtype=wp.int64)
UNIT = 62  # bits of a whole number, less those that the number of its summands takes


@wp.func_native(_CELL + _FORWARD)
def forward_native(
    item: int, count: int, many: int, height: int, width: int, channels: int, planes: F32,
    points: F32, out: F32,
): ...  # fmt: skip


@wp.kernel
def sample(
    count: int,  # points
    many: int,  # planes
    height: int, width: int, channels: int,
    planes: F32,  # [many, height, width, channels]
    points: F32,  # [many, count, 2] in [-1, 1]
    out: F32,  # [count, many, channels]
    base: int, items: int,  # a number of `out` each
):  # fmt: skip
    item = base + wp.tid()
    if item < items:
        forward_native(item, count, many, height, width, channels, planes, points, out)


@wp.func_native(_CELL + _TO_PLANES)
def planes_native(
    item: int, count: int, many: int, height: int, width: int, channels: int, points: F32,
    upstream: F32, largest: F32, unit: wp.float64, sums: I64,
): ...  # fmt: skip


@wp.kernel
def add_to_planes(
    count: int, many: int, height: int, width: int, channels: int, points: F32,
    upstream: F32,  # [count, many, channels]
    largest: F32,  # [1]: of its magnitudes
    unit: wp.float64,  # the whole number that stands for the largest
    sums: I64,  # [many, height, width, channels], zero
    base: int, items: int,  # a number of `upstream` each
):  # fmt: skip
    item = base + wp.tid()
    if item < items:
        planes_native(
            item, count, many, height, width, channels, points, upstream, largest, unit, sums
        )


@wp.func_native(_CELL + _TO_POINTS)
def points_native(
    item: int, count: int, many: int, height: int, width: int, channels: int, planes: F32,
    points: F32, upstream: F32, to_points: F32,
): ...  # fmt: skip


@wp.kernel
def points_adjoint(
    count: int, many: int, height: int, width: int, channels: int, planes: F32, points: F32,
    upstream: F32,
    to_points: F32,  # [many, count, 2]
    base: int, items: int,  # a plane of a point each
):  # fmt: skip
    item = base + wp.tid()
    if item < items:
        points_native(
            item, count, many, height, width, channels, planes, points, upstream, to_points
        )


_STREAMS = CudaStreams()


def _launch(kernel: Any, items: int, arguments: list[Any], on_cuda: bool) -> None:
    if on_cuda:
        _STREAMS.current().each(kernel, items, arguments)
    elif items:
        prepared(kernel, items, [*arguments, 0, items]).launch()


def sample_planes(planes: Tensor, points: Tensor) -> Any:
    """As `feature_planes.sample_planes`, of samples whose indices are 32-bit numbers."""
    numbers = points.shape[0] * points.shape[1] * planes.shape[3]
    return SampledPlanes.apply(planes, points) if numbers < 2**31 else NotImplemented


class SampledPlanes(torch.autograd.Function):
    """`feature_planes.sample_planes`, of float32 tensors on CUDA; two runs agree bit for bit."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, points: Tensor) -> Tensor:
        planes, points = planes.contiguous(), points.contiguous()
        many, height, width, channels = planes.shape
        count = points.shape[1]
        ctx.sizes = [count, many, height, width, channels]
        ctx.save_for_backward(planes, points)
        out = planes.new_empty(count, many * channels)
        with torch.cuda.device_of(planes):
            _launch(sample, out.numel(), [*ctx.sizes, planes, points, out], planes.is_cuda)
        return out

    @staticmethod
    @first_order("the CUDA kernel of feature planes", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        planes, points = ctx.saved_tensors
        with_planes, with_points = ctx.needs_input_grad
        upstream, to_planes, to_points = upstream.contiguous(), None, None
        items, count = upstream.numel(), len(upstream)
        with torch.cuda.device_of(planes):
            if with_planes and items == 0:
                to_planes = torch.zeros_like(planes)
            elif with_planes:
                largest = torch.linalg.vector_norm(upstream, torch.inf)
                unit = 2.0 ** (UNIT - (4 * count).bit_length())
                sums = torch.zeros_like(planes, dtype=torch.int64)
                arguments = [*ctx.sizes, points, upstream, largest, unit, sums]
                _launch(add_to_planes, items, arguments, planes.is_cuda)
                # 0 if all are 0, whatever stands in the sums, and not finite where one is not
                to_planes = (sums * (largest.double() / unit)).to(planes.dtype)
            if with_points:
                to_points = torch.empty_like(points)
                arguments = [*ctx.sizes, planes, points, upstream, to_points]
                _launch(points_adjoint, count * points.shape[0], arguments, planes.is_cuda)
        return to_planes, to_points
