# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Bilinear samples of feature planes: one kernel forward and one backward."""

from typing import Any

import torch
from torch import Tensor

from hoigs.core.fast.launch import CPU_FLAGS, shared
from hoigs.core.first_order import IN_TORCH, first_order
from hoigs.core.system.quiet_warp import wp

# C++ of bilinear samples of feature planes, and of their gradients.
#
# A work item is taken by one core, and no two items write the same memory: a chunk of points in the
# forward pass; in the backward pass LANES channels of one plane, to which all points add one after
# the other, or a chunk of points, whose own gradient is summed over channels. So results do not
# depend on the number of cores. Casts are written (float)(x), since `float(x)` is a macro of Warp.
# The arguments are described in `kernels`.

LANES = 16
CHUNK = 512  # points
# From a coordinate in [-1, 1] to the cell before it, how far behind that it is, and the derivative
# of the place, in cells, by the coordinate.
AXIS = r"""
    auto axis = [](float u, int cells, float& f, float& slope) -> int {
        const float share = (u + 1.0f) / 2.0f;
        const float size = (float)(cells - 1);
        slope = share >= 0.0f && share <= 1.0f ? size / 2.0f : 0.0f;
        const float at = (share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share) * size;
        // comparisons with NaN are false: it reads the last cell, and f is NaN
        float corner = at < size - 1.0f ? $FLOOR(at) : size - 1.0f;
        corner = corner > 0.0f ? corner : 0.0f;
        f = at - corner;
        return (int)corner;
    };
"""
_CELL = r"""
    constexpr int LANES = $LANES, CHUNK = $CHUNK;
    typedef float vec __attribute__((vector_size(4 * LANES)));
    typedef float loose __attribute__((vector_size(4 * LANES), aligned(4)));
    auto load = [](const float* at) -> vec { return *(const loose*)at; };
    const float* planes_ = (const float*)planes.data;
    const float* points_ = (const float*)points.data;
    const int chunks = (count + CHUNK - 1) / CHUNK;
    // on a plane that is one cell wide or high, the neighbour is the cell itself
    const int right = width > 1 ? channels : 0, below = height > 1 ? width * channels : 0;
    struct Cell {
        int first;  // the corner's first channel
        float fx, fy, slope_x, slope_y;
    };
$AXIS    auto cell_of = [&](int plane, int point) -> Cell {
        const float* at = points_ + 2 * ((long long)plane * count + point);
        Cell cell;
        const int x = axis(at[0], width, cell.fx, cell.slope_x);
        const int y = axis(at[1], height, cell.fy, cell.slope_y);
        cell.first = ((plane * height + y) * width + x) * channels;
        return cell;
    };
    for (;;) {
        const int item = __atomic_fetch_add((int*)counter.data, 1, __ATOMIC_RELAXED);
$BODY
    }
"""
_FORWARD = r"""
        if (item >= chunks) break;
        const int end = (item + 1) * CHUNK < count ? (item + 1) * CHUNK : count;
        for (int point = item * CHUNK; point < end; ++point) {
            float* out_ = (float*)out.data + (long long)point * many * channels;
            for (int plane = 0; plane < many; ++plane, out_ += channels) {
                const Cell cell = cell_of(plane, point);
                const float* row = planes_ + cell.first;
                const float w00 = (1.0f - cell.fy) * (1.0f - cell.fx);
                const float w01 = (1.0f - cell.fy) * cell.fx;
                const float w10 = cell.fy * (1.0f - cell.fx), w11 = cell.fy * cell.fx;
                int c = 0;
                for (; c + LANES <= channels; c += LANES)
                    *(loose*)(out_ + c) = load(row + c) * w00 + load(row + right + c) * w01
                        + load(row + below + c) * w10 + load(row + below + right + c) * w11;
                for (; c < channels; ++c)
                    out_[c] = row[c] * w00 + row[right + c] * w01 + row[below + c] * w10
                        + row[below + right + c] * w11;
            }
        }
"""
_BACKWARD = r"""
        const int blocks = (channels + LANES - 1) / LANES;
        const int scatters = with_planes ? many * blocks : 0;
        if (item >= scatters + (with_points ? chunks : 0)) break;
        const float* upstream_ = (const float*)upstream.data;
        if (item < scatters) {
            const int plane = item / blocks, c = item % blocks * LANES;
            float* gradient = (float*)to_planes.data + c;
            const float* up = upstream_ + plane * channels + c;
            const int deep = channels - c < LANES ? channels - c : LANES;
            float* cell_gradient = gradient + plane * height * width * channels;
            for (int i = 0; i < height * width; ++i, cell_gradient += channels) {
                if (deep == LANES) *(loose*)cell_gradient = (vec){};
                else for (int k = 0; k < deep; ++k) cell_gradient[k] = 0.0f;
            }
            for (int point = 0; point < count; ++point, up += many * channels) {
                const Cell cell = cell_of(plane, point);
                float* row = gradient + cell.first;
                const float w00 = (1.0f - cell.fy) * (1.0f - cell.fx);
                const float w01 = (1.0f - cell.fy) * cell.fx;
                const float w10 = cell.fy * (1.0f - cell.fx), w11 = cell.fy * cell.fx;
                if (deep == LANES) {
                    // one after the other: on narrow planes these may be the same row
                    const vec v = load(up);
                    *(loose*)row += v * w00;
                    *(loose*)(row + right) += v * w01;
                    *(loose*)(row + below) += v * w10;
                    *(loose*)(row + below + right) += v * w11;
                } else {
                    for (int i = 0; i < deep; ++i) {
                        row[i] += up[i] * w00;
                        row[right + i] += up[i] * w01;
                        row[below + i] += up[i] * w10;
                        row[below + right + i] += up[i] * w11;
                    }
                }
            }
            continue;
        }
        const int start = (item - scatters) * CHUNK;
        const int end = start + CHUNK < count ? start + CHUNK : count;
        for (int point = start; point < end; ++point)
            for (int plane = 0; plane < many; ++plane) {
                const Cell cell = cell_of(plane, point);
                const float* row = planes_ + cell.first;
                const float* up = upstream_ + ((long long)point * many + plane) * channels;
                vec along_x = {}, along_y = {};
                auto add = [&](auto v, auto v00, auto v01, auto v10, auto v11, auto& x, auto& y) {
                    x += v * ((v01 - v00) * (1.0f - cell.fy) + (v11 - v10) * cell.fy);
                    y += v * ((v10 - v00) * (1.0f - cell.fx) + (v11 - v01) * cell.fx);
                };
                int c = 0;
                for (; c + LANES <= channels; c += LANES)
                    add(load(up + c), load(row + c), load(row + right + c), load(row + below + c),
                        load(row + below + right + c), along_x, along_y);
                float x = 0.0f, y = 0.0f;
                for (; c < channels; ++c)
                    add(up[c], row[c], row[right + c], row[below + c], row[below + right + c],
                        x, y);
                for (int i = 0; i < LANES; ++i) {
                    x += along_x[i];
                    y += along_y[i];
                }
                float* gradient = (float*)to_points.data + 2 * ((long long)plane * count + point);
                gradient[0] = x * cell.slope_x;
                gradient[1] = y * cell.slope_y;
            }
"""


def _source(body: str) -> str:
    axis = AXIS.replace("$FLOOR", "__builtin_floorf")
    whole = _CELL.replace("$AXIS", axis).replace("$BODY", body)
    return whole.replace("$LANES", str(LANES)).replace("$CHUNK", str(CHUNK))


FORWARD, BACKWARD = _source(_FORWARD), _source(_BACKWARD)


# Bilinear samples of feature planes on CPUs; the loops stand in `source`.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)


@wp.func_native(FORWARD)
def forward_native(
    counter: I32, count: int, many: int, height: int, width: int, channels: int, planes: F32,
    points: F32, out: F32,
): ...  # fmt: skip


@wp.kernel
def sample(
    counter: I32,  # [1], zero: the next work item, for workers that make this same call
    count: int,  # points
    many: int,  # planes
    height: int, width: int, channels: int,
    planes: F32,  # [many, height, width, channels]
    points: F32,  # [many, count, 2] in [-1, 1]
    out: F32,  # [count, many, channels]
):  # fmt: skip
    forward_native(counter, count, many, height, width, channels, planes, points, out)


@wp.func_native(BACKWARD)
def backward_native(
    counter: I32, count: int, many: int, height: int, width: int, channels: int, planes: F32,
    points: F32, upstream: F32, with_planes: int, with_points: int, to_planes: F32, to_points: F32,
): ...  # fmt: skip


@wp.kernel
def sample_adjoint(
    counter: I32, count: int, many: int, height: int, width: int, channels: int,
    planes: F32, points: F32,  # as of `sample`
    upstream: F32,  # [count, many, channels]
    with_planes: int, with_points: int,
    to_planes: F32,  # [many, height, width, channels], or empty
    to_points: F32,  # [many, count, 2], or empty
):  # fmt: skip
    backward_native(
        counter, count, many, height, width, channels, planes, points, upstream, with_planes,
        with_points, to_planes, to_points,
    )  # fmt: skip


def sample_planes(planes: Tensor, points: Tensor) -> Any:
    """As `feature_planes.sample_planes`, of planes whose indices are 32-bit numbers."""
    return SampledPlanes.apply(planes, points) if planes.numel() < 2**31 else NotImplemented


class SampledPlanes(torch.autograd.Function):
    """`feature_planes.sample_planes`, of float32 tensors on a CPU."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, points: Tensor) -> Tensor:
        planes, points = planes.contiguous(), points.contiguous()
        many, height, width, channels = planes.shape
        count = points.shape[1]
        ctx.sizes = [count, many, height, width, channels]
        ctx.save_for_backward(planes, points)
        out = planes.new_empty(count, many * channels)
        shared(sample, -(-count // CHUNK), [*ctx.sizes, planes, points, out])
        return out

    @staticmethod
    @first_order("the CPU kernel of feature planes", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None]:
        planes, points = ctx.saved_tensors
        with_planes, with_points = ctx.needs_input_grad
        to_planes = torch.empty_like(planes) if with_planes else planes.new_empty(0)
        to_points = torch.empty_like(points) if with_points else planes.new_empty(0)
        shared(
            sample_adjoint,
            -(-len(upstream) // CHUNK),
            [*ctx.sizes, planes, points, upstream.contiguous(), int(with_planes),
             int(with_points), to_planes, to_points],
        )  # fmt: skip
        return to_planes if with_planes else None, to_points if with_points else None
