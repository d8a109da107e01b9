# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""A step of Adam for many float32 parameters, each with its own rate, by one kernel of CUDA."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from hoigs.core.fast.cuda_launch import CudaStreams
from hoigs.core.fast.launch import CPU_FLAGS, prepared
from hoigs.core.system.quiet_warp import wp

THREADS = 256
EACH = 4096  # elements of a parameter that one block steps
# A block of threads reads which parameter is its own from `blocks`, and where the tensors of that
# one are from `table`. On a CPU, for tests, one thread does the work of a block.
_SOURCE = r"""
#if defined(__CUDA_ARCH__)
    #define HOIGS_SHARED __shared__
    #define HOIGS_SYNC __syncthreads()
    constexpr int STEP = $THREADS;
    const int block = thread / STEP, me = thread % STEP;
#else
    #define HOIGS_SHARED
    #define HOIGS_SYNC
    constexpr int STEP = 1;
    const int block = thread, me = 0;
#endif
    HOIGS_SHARED double sizes[2];
    if (!((const unsigned char*)finite.data)[0]) return;
    const int which = ((const int*)blocks.data)[2 * block];
    const long long* at = (const long long*)table.data + 6 * which;
    if (me == 0) {
        const double count = (double)*(const float*)at[4];
        sizes[0] = ((const double*)rates.data)[which] / (1.0 - pow(beta1, count));
        sizes[1] = 1.0 / sqrt(1.0 - pow(beta2, count));
    }
    HOIGS_SYNC;
    const float rate = (float)sizes[0], root = (float)sizes[1];
    float *x = (float*)at[0], *m = (float*)at[2], *v = (float*)at[3];
    const float* g = (const float*)at[1];
    const float decay1 = (float)beta1, decay2 = (float)beta2, least = (float)eps;
    const float rest1 = (float)(1.0 - beta1), rest2 = (float)(1.0 - beta2);
    const long long first = (long long)((const int*)blocks.data)[2 * block + 1] * $EACH;
    const long long end = first + $EACH < at[5] ? first + $EACH : at[5];
    for (long long i = first + me; i < end; i += STEP) {
        const float mean = decay1 * m[i] + rest1 * g[i];
        const float square = decay2 * v[i] + rest2 * g[i] * g[i];
        m[i] = mean;
        v[i] = square;
        x[i] -= rate * mean / (sqrtf(square) * root + least);
    }
    HOIGS_SYNC;  // before the next block of these threads overwrites shared memory
    #undef HOIGS_SHARED
    #undef HOIGS_SYNC
""".replace("$THREADS", str(THREADS)).replace("$EACH", str(EACH))

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
BLOCK = wp.constant(THREADS)
I32 = wp.array(dtype=wp.int32)
I64 = wp.array(dtype=wp.int64)
F64 = wp.array(dtype=wp.float64)
U8 = wp.array(dtype=wp.uint8)


@wp.func_native(_SOURCE)
def step_native(
    thread: int, blocks: I32, table: I64, rates: F64, beta1: wp.float64, beta2: wp.float64,
    eps: wp.float64, finite: U8,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def step_parameters(
    blocks: I32,  # [blocks, 2]: of each the parameter, and which EACH of its elements
    # [parameters, 6]: addresses of values, gradients, first and second moments and of the number
    # of steps, and how many elements there are
    table: I64,
    rates: F64,  # [parameters]
    beta1: wp.float64, beta2: wp.float64, eps: wp.float64,
    finite: U8,  # [1]: 0 leaves everything as it is
):  # fmt: skip
    step_native(wp.tid(), blocks, table, rates, beta1, beta2, eps, finite)


# A parameter's values and gradients, the means of these and of their squares, and how many steps
# there were (a 0-d float32 tensor): contiguous, on one device.
Stepped = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


@wp.func_native("*(float*)((const long long*)table.data)[6 * which + 4] += 1.0f;")
def count_native(which: int, table: I64): ...


@wp.kernel
def count_steps(table: I64, finite: U8, base: int, items: int):
    """Of each parameter, before `step_parameters`."""
    which = base + wp.tid()
    if which < items and finite[0] != wp.uint8(0):
        count_native(which, table)


class AdamKernel:
    """Adam (Kingma and Ba 2015, Algorithm 1) of many parameters in one launch.

    Args:
        betas, eps: as of `torch.optim.Adam`, which does the same by several launches for each rate.
    """

    def __init__(self, betas: tuple[float, float], eps: float) -> None:
        self._numbers = [*betas, eps]
        self._known: tuple[Any, Tensor, Tensor] | None = None
        self._streams = CudaStreams()

    def __call__(
        self, parameters: Sequence[Stepped], rates: Sequence[float], finite: Bool[Tensor, ""]
    ) -> None:
        """Change values and moments, and count the step.

        Args:
            rates: of each parameter. finite: on the device; where it is False nothing changes.
        """
        if not parameters:
            return
        device = parameters[0][0].device
        blocks, table = self._places(parameters, device)
        now = torch.tensor(rates, dtype=torch.float64).to(device, non_blocking=True)
        taken = finite.view(1).view(torch.uint8)
        arguments = [blocks, table, now, *self._numbers, taken]
        count = len(blocks) // 2
        if device.type == "cuda":
            with torch.cuda.device(device):
                stream = self._streams.current()
                stream.each(count_steps, len(parameters), [table, taken])
                stream.blocks(step_parameters, count, THREADS, arguments)
        else:
            prepared(count_steps, len(parameters), [table, taken, 0, len(parameters)]).launch()
            prepared(step_parameters, count, arguments).launch()

    def _places(self, parameters: Sequence[Stepped], device: torch.device) -> tuple[Tensor, Tensor]:
        """`blocks` and `table` of the kernel, kept as long as nothing moves."""
        rows = [(*(x.data_ptr() for x in one), one[0].numel()) for one in parameters]
        if self._known is None or self._known[0] != rows:
            blocks = [
                (which, part)
                for which, row in enumerate(rows)
                for part in range(-(-row[-1] // EACH))
            ]
            found = torch.tensor(blocks, dtype=torch.int32).flatten().to(device)
            self._known = (rows, found, torch.tensor(rows, dtype=torch.int64).flatten().to(device))
        return self._known[1:]
