"""What this machine can do at most: bytes copied, and vector operations of the CPU kernels."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from string import Template
from typing import Any

import torch

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.cpu.tile_source import MAX_ROWS, PASS_CHANNELS, VECTORS

F32 = wp.array(dtype=wp.float32)
_HEAD = Template(VECTORS).substitute(MAX_ROWS=MAX_ROWS, PASS_CHANNELS=PASS_CHANNELS)
CHAINS = 12  # multiply-adds in flight, so that latency does not count
EXPONENTIALS = 8


@wp.func_native(
    _HEAD
    + r"""
    float* p = (float*)data.data;
    vec x[12];
    for (int j = 0; j < 12; ++j) x[j] = same(p[j]);
    const vec a = same(p[12]), b = same(p[13]);
    for (int i = 0; i < count; ++i)
        for (int j = 0; j < 12; ++j) x[j] = x[j] * a + b;
    for (int j = 1; j < 12; ++j) x[0] += x[j];
    p[0] = x[0][0] + (float)LANES;
    p[15] = (float)LANES;
"""
)
def multiply_add_native(count: int, data: F32): ...  # type: ignore[no-untyped-def, valid-type]


@wp.func_native(
    _HEAD
    + r"""
    float* p = (float*)data.data;
    vec x[8];
    for (int j = 0; j < 8; ++j) x[j] = same(p[j]) - counting;
    for (int i = 0; i < count; ++i)
        for (int j = 0; j < 8; ++j) x[j] = power_of_2(x[j]) - 1.0f;
    for (int j = 1; j < 8; ++j) x[0] += x[j];
    p[0] = x[0][0];
"""
)
def exponential_native(count: int, data: F32): ...  # type: ignore[no-untyped-def, valid-type]


@wp.kernel
def multiply_add(count: int, data: F32):  # type: ignore[no-untyped-def, valid-type]
    multiply_add_native(count, data)


@wp.kernel
def exponential(count: int, data: F32):  # type: ignore[no-untyped-def, valid-type]
    exponential_native(count, data)


wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


def _fastest(run: Callable[[int], None], threads: int, repeats: int = 7) -> float:
    """Seconds that all threads take together, at best."""
    best = float("inf")
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(repeats):
            start = time.perf_counter()
            list(pool.map(run, range(threads)))
            best = min(best, time.perf_counter() - start)
    return best


def _rate(kernel: Any, count: int, each: int, threads: int) -> tuple[float, int]:
    """Vector operations a second of all threads, and the lanes of a vector."""
    data = [torch.rand(16) * 0.5 for _ in range(threads)]
    arrays = [wp.from_torch(x) for x in data]

    def run(index: int) -> None:
        wp.launch(kernel, dim=1, inputs=[count, arrays[index]], device="cpu")

    run(0)
    return threads * count * each / _fastest(run, threads), int(data[0][15])


def _copied(threads: int, megabytes: int = 256) -> float:
    """Bytes read and written a second by all threads, copying far more than caches hold."""
    size = megabytes * 2**20 // 4 // threads
    pieces = [(torch.zeros(size), torch.ones(size)) for _ in range(threads)]

    def run(index: int) -> None:
        pieces[index][0].copy_(pieces[index][1])

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    seconds = _fastest(run, threads)
    torch.set_num_threads(before)
    return threads * 2 * 4 * size / seconds


def measure(threads: int) -> dict[str, float]:
    """The machine's limits with so many threads.

    Returns:
        copy_bytes: read and written a second. multiply_adds: vectors a second. exponentials:
        vectors of 2^x a second. lanes: of a vector.
    """
    multiply_adds, lanes = _rate(multiply_add, 4_000_000, CHAINS, threads)
    exponentials, _ = _rate(exponential, 1_000_000, EXPONENTIALS, threads)
    return {
        "threads": threads,
        "lanes": lanes,
        "copy_bytes": _copied(threads),
        "multiply_adds": multiply_adds,
        "exponentials": exponentials,
    }
