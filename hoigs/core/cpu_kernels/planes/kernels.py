# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Bilinear samples of feature planes on CPUs; the loops stand in `source`."""

from hoigs.core.cpu_kernels.planes import source
from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)


@wp.func_native(source.FORWARD)
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


@wp.func_native(source.BACKWARD)
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
