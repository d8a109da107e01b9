# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""A layer of a network, relu(x W^T + b): one kernel forward and one backward."""

import functools
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from hoigs.core.fast.launch import CPU_FLAGS, shared
from hoigs.core.first_order import IN_TORCH, first_order
from hoigs.core.system.quiet_warp import wp

# C++ of a layer relu(x W^T + b) and of its gradients, for vectors of 16 floats.
#
# A product is made of tiles of 8 rows by 3 vectors, which stay in registers while they are summed.
# The backward pass takes BLOCK rows at a time: the masked upstream gradient and x are copied to
# where all tiles of the block find them in the cache. Gradients of W and b are summed apart for
# every CHUNK rows, and these sums added up by torch, so that results do not depend on the number of
# cores. Casts are written (float)(x), since `float(x)` is a macro of Warp. The arguments are
# described in `kernels`.

CHUNK = 768  # rows of a work item of the backward pass
FORWARD_CHUNK = 64
BLOCK = 96
MAX_WIDTH = 256
LANES, HIGH = 16, 8  # of a tile: columns of one vector, rows
_TILE = r"""
    constexpr int LANES = $LANES, HIGH = $HIGH, BLOCK = $BLOCK, CHUNK = $CHUNK;
    constexpr int MAX_WIDTH = $MAX_WIDTH, FORWARD_CHUNK = $FORWARD_CHUNK;
    typedef float vec __attribute__((vector_size(4 * LANES)));
    typedef int ivec __attribute__((vector_size(4 * LANES)));
    typedef float loose __attribute__((vector_size(4 * LANES), aligned(4)));
    // sums[i][j] += a[i * rows + k * steps] * b[k * width + j * LANES] over k
    auto multiply = [](auto& sums, const float* a, int rows, int steps, const float* b, int width,
                       int length) {
        constexpr int M = sizeof(sums) / sizeof(sums[0]), V = sizeof(sums[0]) / sizeof(vec);
        for (int k = 0; k < length; ++k, a += steps, b += width) {
            vec columns[V];
            #pragma unroll
            for (int j = 0; j < V; ++j) columns[j] = *(const loose*)(b + j * LANES);
            #pragma unroll
            for (int i = 0; i < M; ++i) {
                const float factor = a[i * rows];
                #pragma unroll
                for (int j = 0; j < V; ++j) sums[i][j] += columns[j] * factor;
            }
        }
    };
    // calls work(sums, first column), with as many vectors as are left, up to 3
    auto across = [](int width, auto work) {
        int column = 0;
        for (; column + 3 * LANES <= width; column += 3 * LANES) {
            vec sums[HIGH][3];
            work(sums, column);
        }
        if (column + 2 * LANES <= width) {
            vec sums[HIGH][2];
            work(sums, column);
        } else if (column < width) {
            vec sums[HIGH][1];
            work(sums, column);
        }
    };
    // the first `count` of the columns from `column` on, of the first `high` rows
    auto store = [](auto& sums, float* to, int width, int column, int high) {
        constexpr int M = sizeof(sums) / sizeof(sums[0]), V = sizeof(sums[0]) / sizeof(vec);
        #pragma unroll
        for (int i = 0; i < M; ++i) {
            if (i >= high) break;
            #pragma unroll
            for (int j = 0; j < V; ++j) {
                const int at = column + j * LANES;
                float* row = to + (long long)i * width + at;
                if (at + LANES <= width) *(loose*)row = sums[i][j];
                else for (int l = 0; at + l < width; ++l) row[l] = sums[i][j][l];
            }
        }
    };
    for (;;) {
        const int item = __atomic_fetch_add((int*)counter.data, 1, __ATOMIC_RELAXED);
$BODY
    }
"""
_FORWARD = r"""
        const int start = item * FORWARD_CHUNK;
        if (start >= count) break;
        const int end = start + FORWARD_CHUNK < count ? start + FORWARD_CHUNK : count;
        const float* rows_ = (const float*)rows.data;
        const float* weight_ = (const float*)weight.data;
        const float* bias_ = (const float*)bias.data;
        float* out_ = (float*)out.data;
        across(padded, [&](auto& sums, int column) {
            constexpr int V = sizeof(sums[0]) / sizeof(vec);
            for (int row = start; row < end; row += HIGH) {
                // the last rows of all are computed again with some before them, to the same values
                const int from = row + HIGH <= count ? row : count - HIGH;
                for (int i = 0; i < HIGH; ++i)
                    for (int j = 0; j < V; ++j)
                        sums[i][j] = *(const loose*)(bias_ + column + j * LANES);
                multiply(sums, rows_ + (long long)from * entry, entry, 1, weight_ + column, stride,
                         entry);
                if (relu)
                    for (int i = 0; i < HIGH; ++i)
                        for (int j = 0; j < V; ++j)
                            sums[i][j] = sums[i][j] < 0.0f ? (vec){} : sums[i][j];
                store(sums, out_ + (long long)from * width, width, column, HIGH);
            }
        });
"""
_BACKWARD = r"""
        const int start = item * CHUNK;
        if (start >= count) break;
        const int end = start + CHUNK < count ? start + CHUNK : count;
        const int high = (width + HIGH - 1) / HIGH * HIGH;
        const int wide = (width + LANES - 1) / LANES * LANES;
        const float* rows_ = (const float*)rows.data;
        const float* weight_ = (const float*)weight.data;
        const float* result_ = (const float*)result.data;
        const float* upstream_ = (const float*)upstream.data;
        float* to_rows_ = (float*)to_rows.data;
        float* to_weight_ = (float*)to_weight.data + (long long)item * (high * padded + wide);
        float* to_bias_ = to_weight_ + high * padded;
        alignas(64) float above[BLOCK * MAX_WIDTH];  // upstream, masked
        alignas(64) float below[BLOCK * MAX_WIDTH];  // x, where its rows are no whole vectors
        for (int first = start; first < end; first += BLOCK) {
            const int lines = first + BLOCK < end ? BLOCK : end - first;
            for (int r = 0; r < lines; ++r) {
                const float* up = upstream_ + (long long)(first + r) * width;
                const float* made = result_ + (long long)(first + r) * width;
                float* to = above + r * wide;
                int c = 0;
                for (; c + LANES <= width; c += LANES) {
                    vec v = *(const loose*)(up + c);
                    if (relu) v = (vec)((ivec)v & ~(*(const loose*)(made + c) <= 0.0f));
                    *(vec*)(to + c) = v;
                    if (with_weight) *(loose*)(to_bias_ + c) += v;
                }
                for (; c < wide; ++c) {
                    to[c] = c < width && !(relu && made[c] <= 0.0f) ? up[c] : 0.0f;
                    if (with_weight) to_bias_[c] += to[c];
                }
            }
            if (with_rows) across(padded, [&](auto& sums, int column) {
                constexpr int V = sizeof(sums[0]) / sizeof(vec);
                for (int r = 0; r < lines; r += HIGH) {
                    for (int i = 0; i < HIGH; ++i)
                        for (int j = 0; j < V; ++j) sums[i][j] = (vec){};
                    multiply(sums, above + r * wide, wide, 1, weight_ + column, stride, width);
                    store(sums, to_rows_ + (long long)(first + r) * entry, entry, column,
                          lines - r < HIGH ? lines - r : HIGH);
                }
            });
            if (!with_weight) continue;
            const float* x = rows_ + (long long)first * entry;
            if (padded != entry) {
                for (int r = 0; r < lines; ++r)
                    for (int c = 0; c < padded; ++c)
                        below[r * padded + c] = c < entry ? x[r * entry + c] : 0.0f;
                x = below;
            }
            across(padded, [&](auto& sums, int column) {
                constexpr int V = sizeof(sums[0]) / sizeof(vec);
                for (int out = 0; out < high; out += HIGH) {
                    float* to = to_weight_ + out * padded + column;
                    for (int i = 0; i < HIGH; ++i)
                        for (int j = 0; j < V; ++j)
                            sums[i][j] = *(const loose*)(to + i * padded + j * LANES);
                    multiply(sums, above + out, 1, wide, x + column, padded, lines);
                    for (int i = 0; i < HIGH; ++i)
                        for (int j = 0; j < V; ++j)
                            *(loose*)(to + i * padded + j * LANES) = sums[i][j];
                }
            });
        }
"""


def _source(body: str) -> str:
    whole = _TILE.replace("$BODY", body)
    for name in ("LANES", "HIGH", "BLOCK", "FORWARD_CHUNK", "CHUNK", "MAX_WIDTH"):
        whole = whole.replace(f"${name}", str(globals()[name]))
    return whole


FORWARD, BACKWARD = _source(_FORWARD), _source(_BACKWARD)


# A layer of a network on CPUs; the loops stand in `source`.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)


@wp.func_native(FORWARD)
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


@wp.func_native(BACKWARD)
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


WORTHWHILE = 256  # rows: fewer take as long either way


def dense(layers: nn.Sequential, rows: Tensor) -> Any:
    """As `networks.dense`, on CPUs with AVX-512: fused, where torch takes MKL for float32, which on
    processors of AMD has AVX2 only."""
    linears = [layer for layer in layers if isinstance(layer, nn.Linear)]
    widths = [size for layer in linears for size in (layer.in_features, layer.out_features)]
    if len(rows) < WORTHWHILE or not wide_vectors() or max(widths) > MAX_WIDTH:
        return NotImplemented
    chain = list(layers)
    for layer, after in zip(chain, [*chain[1:], None], strict=True):
        if isinstance(layer, nn.Linear):
            relu = isinstance(after, nn.ReLU)
            rows = DenseLayer.apply(rows, layer.weight, layer.bias, relu)
        elif not isinstance(layer, nn.ReLU):
            raise TypeError(f"dense: expected Linear and ReLU, got {type(layer).__name__}")
    return rows


@functools.cache
def wide_vectors() -> bool:
    return torch.backends.cpu.get_cpu_capability() == "AVX512"


def whole_vectors(width: int) -> tuple[int, int]:
    """Columns of a matrix up to whole vectors, and a distance between its rows.

    An odd number of vectors, so that the rows of a tile do not share a few sets of the cache.
    """
    padded = width + -width % LANES
    return padded, padded + LANES * (padded // LANES % 2 == 0)


class DenseLayer(torch.autograd.Function):
    """`relu(rows @ weight.T + bias)`, or without ReLU, of float32 tensors on a CPU.

    There are at least HIGH rows.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
        rows = rows.contiguous()
        (count, entry), width = rows.shape, len(weight)
        padded, stride = whole_vectors(width)
        ctx.relu = int(relu)
        out = rows.new_empty(count, width)
        shift = rows.new_zeros(padded) if bias is None else pad(bias, (0, padded - width))
        shared(
            layer,
            -(-count // FORWARD_CHUNK),
            [count, entry, width, padded, stride, ctx.relu, rows,
             pad(weight.t(), (0, stride - width)), shift, out],
        )  # fmt: skip
        ctx.save_for_backward(rows, weight, out if relu else None)
        return out

    @staticmethod
    @first_order("the CPU kernel of dense layers", IN_TORCH)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight, result = ctx.saved_tensors
        (count, entry), width = rows.shape, len(weight)
        with_rows, with_weight, with_bias, _ = ctx.needs_input_grad
        padded, stride = whole_vectors(entry)
        high, wide, chunks = width + -width % HIGH, width + -width % LANES, -(-count // CHUNK)
        nothing = rows.new_empty(0)
        to_rows = torch.empty_like(rows) if with_rows else nothing
        summed = with_weight or with_bias
        sums = rows.new_zeros(chunks, high * padded + wide) if summed else nothing
        shared(
            layer_adjoint,
            chunks,
            [count, entry, width, padded, stride, ctx.relu, rows,
             pad(weight, (0, stride - entry)), result if ctx.relu else nothing,
             upstream.contiguous(), int(with_rows), int(summed), to_rows, sums],
        )  # fmt: skip
        whole = sums.sum(0) if summed else nothing
        matrix, rest = whole[: high * padded], whole[high * padded :]
        return (
            to_rows if with_rows else None,
            matrix.view(high, padded)[:width, :entry].contiguous() if with_weight else None,
            rest[:width].clone() if with_bias else None,
            None,
        )
