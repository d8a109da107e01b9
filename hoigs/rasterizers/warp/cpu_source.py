"""C++ of the fast CPU path, compiled by Warp's own Clang: no compiler on the user's machine.

FORWARD and BACKWARD are put together from `cpu_vectors` (how tiles lie in vectors), `cpu_splats`
(where a splat is, and its alpha) and what each of them does with a block, which stands here and
in `cpu_adjoint`.
"""

from string import Template

from hoigs.rasterizers.warp import cpu_adjoint, cpu_splats, cpu_vectors


def _filled(text: str, **parts: object) -> str:
    """The text with $NAMEs replaced."""
    return Template(text).substitute(parts)


_PIXELS = r"""
    const float* back = background_ + o * background_stride;
    float out[5][8] __attribute__((aligned(32)));
    *(f8*)out[0] = row_of(p.red, h);
    *(f8*)out[1] = row_of(p.green, h);
    *(f8*)out[2] = row_of(p.blue, h);
    *(f8*)out[3] = row_of(left, h);
    *(f8*)out[4] = row_of(p.dist, h);
    float* first = color_ + 3 * o;
    for (int i = 0; i < columns; ++i)
        for (int j = 0; j < 3; ++j)
            first[3 * i + j] = out[j][i]
                + out[3][i] * back[i * background_stride + j];
    for (int i = 0; i < columns; ++i) alpha_[o + i] = 1.0f - out[3][i];
    for (int i = 0; i < columns; ++i) depth_[o + i] = out[4][i];
"""
_EXTRA_PIXELS = r"""
    for (int j = 0; j < extras; ++j) {
        const f8 row = row_of(more[j][at], h);
        for (int i = 0; i < columns; ++i)
            extra_[(o + i) * channels + pass + j] = row[i];
    }
    if (pass != 0) continue;
"""
_COMPOSITE = r"""
    p.red += weight * g[6];
    p.green += weight * g[7];
    p.blue += weight * g[8];
    p.dist += weight * g[9];
"""
_EXTRAS = r"""
    for (int j = 0; j < extras; ++j)
        for (int s = 0; s < 2; ++s)
            for (int b = s * BLOCKS + first[s]; b <= s * BLOCKS + last[s]; ++b)
                more[j][b] += weights[b] * f[j];
"""
_IMAGE = _filled(
    cpu_vectors.EACH_ROW,
    BEFORE="const vec left = (vec)((ivec)p.T & ~SIGN);",
    ROW=_EXTRA_PIXELS + _PIXELS,
    AFTER="",
)


def _splats(prefetch: str, composite: str, **parts: str) -> str:
    alpha = _filled(cpu_splats.ALPHA, BLOCK=_filled(cpu_splats.BLOCK, COMPOSITE=composite))
    geometry = _filled(cpu_splats.GEOMETRY, PREFETCH=prefetch)
    return _filled(cpu_splats.SPLATS, **parts, GEOMETRY=geometry, ALPHA=alpha)


_SIZES = {"MAX_ROWS": cpu_vectors.MAX_ROWS, "EXTRA": cpu_vectors.EXTRA}


def _kernel(state: str, head: str, body: str) -> str:
    vectors = _filled(cpu_vectors.VECTORS, **_SIZES)
    start = vectors + cpu_vectors.ARGUMENTS + cpu_splats.LIMITS
    return start + state + head + _filled(cpu_vectors.TILES, BODY=body)


FORWARD = _kernel(
    "struct Block { vec T, red, green, blue, dist; };",
    "",
    _splats("", _COMPOSITE, BEFORE="", STRIP_END="", STRIP="", AFTER=_EXTRAS) + _IMAGE,
)
BACKWARD = _kernel(
    cpu_adjoint.STATE,
    cpu_adjoint.HEAD,
    _filled(
        cpu_vectors.EACH_ROW,
        BEFORE=cpu_adjoint.LOAD_BEGIN,
        ROW=cpu_adjoint.LOAD,
        AFTER=cpu_adjoint.LOAD_END,
    )
    + _splats(
        "__builtin_prefetch(partials_ + (long long)pairs_[2 * ahead + 1] * stride, 1);",
        cpu_adjoint.COMPOSITE,
        BEFORE=cpu_adjoint.BEFORE,
        STRIP_END=cpu_adjoint.STRIP_END,
        STRIP=cpu_adjoint.STRIP,
        AFTER=cpu_adjoint.AFTER,
    ),
)

LANES = _filled(cpu_vectors.VECTORS, **_SIZES) + "*(int*)lanes.data = LANES;"

PREFETCH = r"""__builtin_prefetch((const float*)array.data + index);"""

# The number of the next piece of work, for workers that share `counters`.
TAKE = r"""return __atomic_fetch_add((int*)counters.data + counter, 1, __ATOMIC_RELAXED);"""

# Address of a function that drains a queue of compiled kernels; each worker of a pool calls it.
QUEUE = r"""
    struct Job { void (*run)(void*, void*); void* bounds; void* arguments; };
    struct Queue { Job* jobs; int count; int next; };
    auto drain = [](void* data) {
        Queue* queue = (Queue*)data;
        for (;;) {
            const int i = __atomic_fetch_add(&queue->next, 1, __ATOMIC_RELAXED);
            if (i >= queue->count) break;
            queue->jobs[i].run(queue->jobs[i].bounds, queue->jobs[i].arguments);
        }
    };
    void (*entry)(void*) = drain;
    *(unsigned long long*)address.data = (unsigned long long)entry;
"""
