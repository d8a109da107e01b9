# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Skinning and products of quaternions on CPUs; the loops stand in `source`."""

from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp
from hoigs.core.cpu_kernels.skin import source

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)


@wp.func_native(source.COMPOSE)
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


@wp.func_native(source.SKIN)
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


@wp.func_native(source.SKIN_ADJOINT)
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
