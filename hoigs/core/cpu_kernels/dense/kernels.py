# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""A layer of a network on CPUs; the loops stand in `source`."""

from hoigs.core.cpu_kernels.dense import source
from hoigs.core.cpu_kernels.runtime import CPU_FLAGS, wp

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)


@wp.func_native(source.FORWARD)
def forward_native(
    counter: I32, count: int, entry: int, width: int, padded: int, stride: int, relu: int,
    rows: F32, weight: F32, bias: F32, out: F32,
): ...  # fmt: skip


@wp.kernel
def layer(
    counter: I32,  # [1], zero: the next work item, for workers that make this same call
    count: int,  # rows, at least source.HIGH
    entry: int, width: int,  # columns of `rows` and of `out`
    padded: int,  # `width`, up to whole vectors
    stride: int,  # of the rows of `weight`, at least `padded`
    relu: int,
    rows: F32,  # [count, entry]
    weight: F32,  # [entry, stride]
    bias: F32,  # [padded]
    out: F32,  # [count, width]
):  # fmt: skip
    forward_native(counter, count, entry, width, padded, stride, relu, rows, weight, bias, out)


@wp.func_native(source.BACKWARD)
def backward_native(
    counter: I32, count: int, entry: int, width: int, padded: int, stride: int, relu: int,
    rows: F32, weight: F32, result: F32, upstream: F32, with_rows: int, with_weight: int,
    to_rows: F32, to_weight: F32,
): ...  # fmt: skip


@wp.kernel
def layer_adjoint(
    counter: I32, count: int, entry: int, width: int,
    padded: int,  # `entry`, up to whole vectors
    stride: int,  # of the rows of `weight`, at least `padded`
    relu: int,
    rows: F32,  # [count, entry]
    weight: F32,  # [width, stride]
    result: F32,  # [count, width], read with `relu`
    upstream: F32,  # [count, width]
    with_rows: int, with_weight: int,
    to_rows: F32,  # [count, entry], or empty
    to_weight: F32,  # zero: of each chunk [high, padded], then of its bias [wide], where these are
    # `width` up to whole tiles, and up to whole vectors
):  # fmt: skip
    backward_native(
        counter, count, entry, width, padded, stride, relu, rows, weight, result, upstream,
        with_rows, with_weight, to_rows, to_weight,
    )  # fmt: skip
