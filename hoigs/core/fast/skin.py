# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Skinning of points and rotations, and products of quaternions: one kernel for each pass."""

from typing import Any

import torch
from torch import Tensor

from hoigs.core.fast.launch import CPU_FLAGS, shared
from hoigs.core.first_order import IN_TORCH, first_order
from hoigs.core.system.quiet_warp import wp

# C++ of the skinning of points and rotations, of products of quaternions, and of their gradients.
#
# The weighted mean of a point's joints is one sum of vectors of 16: twelve numbers of each joint's
# transform and four of its quaternion. A work item is CHUNK points; gradients of the joints are
# summed apart for each, and these sums added up by torch, so that results do not depend on the
# number of cores. Casts are written (float)(x), since `float(x)` is a macro of Warp. The arguments
# are described in `kernels`.

CHUNK = 512  # points
MAX_JOINTS = 256
LANES = 16
_QUATERNIONS = r"""
    constexpr int LANES = $LANES, CHUNK = $CHUNK, MAX_JOINTS = $MAX_JOINTS;
    typedef float vec __attribute__((vector_size(4 * LANES)));
    typedef float loose __attribute__((vector_size(4 * LANES), aligned(4)));
    typedef float f4 __attribute__((vector_size(16), aligned(4)));
    typedef float quat __attribute__((vector_size(16)));
    auto load4 = [](const float* at) -> quat { return *(const f4*)at; };
    auto product = [](quat a, quat b) -> quat {
        return (quat){a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
                      a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
                      a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
                      a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
    };
    auto inverse = [](quat a) -> quat { return a * (quat){1.0f, -1.0f, -1.0f, -1.0f}; };
    auto dot = [](quat a, quat b) -> float {
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    };
    auto one_over_length = [&](quat a) -> float {
        const float length = __builtin_sqrtf(dot(a, a));
        return 1.0f / (length < 1e-12f ? 1e-12f : length);
    };
    // of a quaternion before it was normalised to `unit`
    auto before = [&](quat v, quat unit, float inverse_length) -> quat {
        return (v - unit * dot(unit, v)) * inverse_length;
    };
    for (;;) {
        const int item = __atomic_fetch_add((int*)counter.data, 1, __ATOMIC_RELAXED);
        const int start = item * CHUNK;
        if (start >= count) break;
        const int end = start + CHUNK < count ? start + CHUNK : count;
$BODY
    }
"""
_COMPOSE = r"""
        for (int i = 4 * start; i < 4 * end; i += 4) {
            const quat a = load4((const float*)first.data + i) + (quat){offset, 0.0f, 0.0f, 0.0f};
            const quat b = load4((const float*)second.data + i);
            const float over_a = one_over_length(a), over_b = one_over_length(b);
            const quat unit_a = a * over_a, unit_b = b * over_b;
            if (adjoint) {
                const quat v = load4((const float*)upstream.data + i);
                const quat v_a = product(v, inverse(unit_b)), v_b = product(inverse(unit_a), v);
                *(f4*)((float*)out.data + i) = before(v_a, unit_a, over_a);
                *(f4*)((float*)to_second.data + i) = before(v_b, unit_b, over_b);
            } else {
                *(f4*)((float*)out.data + i) = product(unit_a, unit_b);
            }
        }
"""
_MEAN = r"""
        const float* table_ = (const float*)table.data;
        auto mean = [&](const float* weight) -> vec {
            vec sums[4] = {};
            int j = 0;
            for (; j + 4 <= joints; j += 4)
                for (int k = 0; k < 4; ++k)
                    sums[k] += *(const loose*)(table_ + LANES * (j + k)) * weight[j + k];
            for (; j < joints; ++j) sums[0] += *(const loose*)(table_ + LANES * j) * weight[j];
            return (sums[0] + sums[1]) + (sums[2] + sums[3]);
        };
"""
_SKIN = (
    _MEAN
    + r"""
        for (int i = start; i < end; ++i) {
            const vec m = mean((const float*)weights.data + (long long)i * joints);
            const float* p = (const float*)points.data + 3 * i;
            float* out = (float*)means.data + 3 * i;
            for (int k = 0; k < 3; ++k)
                out[k] = m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3];
            const quat q = {m[12], m[13], m[14], m[15]};
            *(f4*)((float*)turned.data + 4 * i) =
                product(q * one_over_length(q), load4((const float*)quats.data + 4 * i));
        }
"""
)
_SKIN_ADJOINT = (
    _MEAN
    + r"""
        const int vectors = (joints + LANES - 1) / LANES;
        float* to_table_ = (float*)to_table.data + (long long)item * joints * LANES;
        alignas(64) float across[LANES][MAX_JOINTS];  // the table, a row for each of its columns
        for (int k = 0; k < LANES; ++k)
            for (int j = 0; j < vectors * LANES; ++j)
                across[k][j] = j < joints ? table_[LANES * j + k] : 0.0f;
        for (int i = start; i < end; ++i) {
            const float* weight = (const float*)weights.data + (long long)i * joints;
            const vec m = mean(weight);
            const float* p = (const float*)points.data + 3 * i;
            const float* v = (const float*)to_means.data + 3 * i;
            const quat q = {m[12], m[13], m[14], m[15]};
            const float over = one_over_length(q);
            const quat unit = q * over, up = load4((const float*)to_turned.data + 4 * i);
            const quat own = load4((const float*)quats.data + 4 * i);
            const quat v_q = before(product(up, inverse(own)), unit, over);
            *(f4*)((float*)to_quats.data + 4 * i) = product(inverse(unit), up);
            for (int k = 0; k < 3; ++k)
                ((float*)to_points.data)[3 * i + k] =
                    m[k] * v[0] + m[4 + k] * v[1] + m[8 + k] * v[2];
            vec to_mean;
            for (int k = 0; k < 3; ++k) {
                for (int l = 0; l < 3; ++l) to_mean[4 * k + l] = v[k] * p[l];
                to_mean[4 * k + 3] = v[k];
            }
            for (int k = 0; k < 4; ++k) to_mean[12 + k] = v_q[k];
            if (with_table)
                for (int j = 0; j < joints; ++j)
                    *(loose*)(to_table_ + LANES * j) += to_mean * weight[j];
            if (!with_weights) continue;
            float* to_weight = (float*)to_weights.data + (long long)i * joints;
            for (int b = 0; b < vectors; ++b) {
                vec sum = {}, other = {};
                for (int k = 0; k < LANES; k += 2) {
                    sum += *(const vec*)(across[k] + LANES * b) * to_mean[k];
                    other += *(const vec*)(across[k + 1] + LANES * b) * to_mean[k + 1];
                }
                sum += other;
                if (LANES * (b + 1) <= joints) *(loose*)(to_weight + LANES * b) = sum;
                else for (int l = 0; LANES * b + l < joints; ++l) to_weight[LANES * b + l] = sum[l];
            }
        }
"""
)


def _source(body: str) -> str:
    whole = _QUATERNIONS.replace("$BODY", body)
    for name, value in (("LANES", LANES), ("CHUNK", CHUNK), ("MAX_JOINTS", MAX_JOINTS)):
        whole = whole.replace(f"${name}", str(value))
    return whole


COMPOSE, SKIN, SKIN_ADJOINT = _source(_COMPOSE), _source(_SKIN), _source(_SKIN_ADJOINT)


# Skinning and products of quaternions on CPUs; the loops stand in `source`.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)


@wp.func_native(COMPOSE)
def compose_native(
    counter: I32, count: int, offset: float, first: F32, second: F32, adjoint: int, upstream: F32,
    out: F32, to_second: F32,
): ...  # fmt: skip


@wp.kernel
def compose(
    counter: I32,  # [1], zero: the next work item, for workers that make this same call
    count: int,
    offset: float,  # added to the real parts of `first`
    first: F32,  # [count, 4]
    second: F32,  # [count, 4]
    adjoint: int,  # else `out` is the product
    upstream: F32,  # [count, 4], with `adjoint`
    out: F32,  # [count, 4]; with `adjoint` the gradient of `first`
    to_second: F32,  # [count, 4], with `adjoint`
):  # fmt: skip
    compose_native(counter, count, offset, first, second, adjoint, upstream, out, to_second)


@wp.func_native(SKIN)
def skin_native(
    counter: I32, count: int, joints: int, points: F32, quats: F32, weights: F32, table: F32,
    means: F32, turned: F32,
): ...  # fmt: skip


@wp.kernel
def skin(
    counter: I32, count: int,
    joints: int,  # at most source.MAX_JOINTS
    points: F32,  # [count, 3]
    quats: F32,  # [count, 4]
    weights: F32,  # [count, joints]
    table: F32,  # [joints, 16]: three rows of the transform, and the quaternion
    means: F32,  # [count, 3]
    turned: F32,  # [count, 4]
):  # fmt: skip
    skin_native(counter, count, joints, points, quats, weights, table, means, turned)


@wp.func_native(SKIN_ADJOINT)
def skin_adjoint_native(
    counter: I32, count: int, joints: int, points: F32, quats: F32, weights: F32, table: F32,
    to_means: F32, to_turned: F32, with_weights: int, with_table: int, to_points: F32,
    to_quats: F32, to_weights: F32, to_table: F32,
): ...  # fmt: skip


@wp.kernel
def skin_adjoint(
    counter: I32, count: int, joints: int,
    points: F32, quats: F32, weights: F32, table: F32,  # as of `skin`
    to_means: F32, to_turned: F32,  # upstream
    with_weights: int, with_table: int,
    to_points: F32,  # [count, 3]
    to_quats: F32,  # [count, 4]
    to_weights: F32,  # [count, joints], or empty
    to_table: F32,  # zero: [chunks, joints, 16], or empty
):  # fmt: skip
    skin_adjoint_native(
        counter, count, joints, points, quats, weights, table, to_means, to_turned, with_weights,
        with_table, to_points, to_quats, to_weights, to_table,
    )  # fmt: skip


def turned_quats(change: Tensor, quats: Tensor) -> Tensor:
    """As `rotations.turned_quats`."""
    return ComposedQuats.apply(change, quats, 1.0)


def skin_gaussians(
    points: Tensor, quats: Tensor, weights: Tensor, transforms: Tensor, turns: Tensor
) -> Any:
    """As `skinning.skin_gaussians`, of no more joints than the kernel takes."""
    if len(turns) > MAX_JOINTS:
        return NotImplemented
    table = torch.cat((transforms[:, :3].flatten(1), turns), 1)
    return SkinnedGaussians.apply(points, quats, weights, table)


class ComposedQuats(torch.autograd.Function):
    """normalise(offset + first) * normalise(second), of float32 quaternions [N, 4] on a CPU."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, offset: float) -> Tensor:
        first, second = first.contiguous(), second.contiguous()
        ctx.offset = offset
        ctx.save_for_backward(first, second)
        out, nothing = torch.empty_like(first), first.new_empty(0)
        count = len(first)
        arguments = [count, offset, first, second, 0, nothing, out, nothing]
        shared(compose, -(-count // CHUNK), arguments)
        return out

    @staticmethod
    @first_order("the CPU kernel of skinning", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor, None]:
        first, second = ctx.saved_tensors
        out, to_second, count = torch.empty_like(first), torch.empty_like(second), len(first)
        arguments = [count, ctx.offset, first, second, 1, upstream.contiguous(), out, to_second]
        shared(compose, -(-count // CHUNK), arguments)
        return out, to_second, None


class SkinnedGaussians(torch.autograd.Function):
    """`skinning.skin_gaussians`, of float32 tensors on a CPU.

    `table` has for each joint three rows of its transform and its quaternion, [J, 16].
    """

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, quats: Tensor, weights: Tensor, table: Tensor
    ) -> tuple[Tensor, Tensor]:
        inputs = [x.contiguous() for x in (points, quats, weights, table)]
        ctx.save_for_backward(*inputs)
        means, turned = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
        count = len(points)
        arguments = [count, len(table), *inputs, means, turned]
        shared(skin, -(-count // CHUNK), arguments)
        return means, turned

    @staticmethod
    @first_order("the CPU kernel of skinning", IN_TORCH)
    def backward(ctx: Any, to_means: Tensor, to_turned: Tensor) -> tuple[Tensor | None, ...]:
        points, quats, weights, table = ctx.saved_tensors
        *_, with_weights, with_table = ctx.needs_input_grad
        count, joints = weights.shape
        chunks, nothing = -(-count // CHUNK), points.new_empty(0)
        to_points, to_quats = torch.empty_like(points), torch.empty_like(quats)
        to_weights = torch.empty_like(weights) if with_weights else nothing
        sums = points.new_zeros(chunks, joints, LANES) if with_table else nothing
        shared(
            skin_adjoint, chunks,
            [count, joints, points, quats, weights, table, to_means.contiguous(),
             to_turned.contiguous(), int(with_weights), int(with_table), to_points, to_quats,
             to_weights, sums],
        )  # fmt: skip
        return (
            to_points,
            to_quats,
            to_weights if with_weights else None,
            sums.sum(0) if with_table else None,
        )
