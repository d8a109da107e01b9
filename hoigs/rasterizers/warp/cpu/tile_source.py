"""C++ of the native CPU kernels; Warp's own Clang compiles it.

FORWARD and BACKWARD are put together from `vector_source` (how tiles lie in vectors),
`splat_source` (where a splat is, and its alpha) and what each of them does with a block, which
stands here and in `backward_source`.
"""

from string import Template

from hoigs.rasterizers.warp.cpu import backward_source, splat_source, vector_source


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
_FEATURE_PIXELS = r"""
    for (int j = 0; j < n_features; ++j) {
        const f8 row = row_of(feature_blocks[j][at], h);
        for (int i = 0; i < columns; ++i)
            feature_image_[(o + i) * channels + pass + j] = row[i];
    }
    if (pass != 0) continue;
"""
_COMPOSITE = r"""
    p.red += weight * g[6];
    p.green += weight * g[7];
    p.blue += weight * g[8];
    p.dist += weight * g[9];
"""
_FEATURES = r"""
    for (int j = 0; j < n_features; ++j)
        for (int s = 0; s < 2; ++s)
            for (int b = s * BLOCKS + first[s]; b <= s * BLOCKS + last[s]; ++b)
                feature_blocks[j][b] += weights[b] * f[j];
"""
_IMAGE = _filled(
    vector_source.EACH_ROW,
    BEFORE="const vec left = (vec)((ivec)p.T & ~SIGN);",
    ROW=_FEATURE_PIXELS + _PIXELS,
    AFTER="",
)


def _splats(prefetch: str, composite: str, **parts: str) -> str:
    alpha = _filled(splat_source.ALPHA, BLOCK=_filled(splat_source.BLOCK, COMPOSITE=composite))
    geometry = _filled(splat_source.GEOMETRY, PREFETCH=prefetch)
    return _filled(splat_source.SPLATS, **parts, GEOMETRY=geometry, ALPHA=alpha)


_SIZES = {"MAX_ROWS": vector_source.MAX_ROWS, "PASS_CHANNELS": vector_source.PASS_CHANNELS}


def _kernel(state: str, head: str, body: str) -> str:
    vectors = _filled(vector_source.VECTORS, **_SIZES)
    start = vectors + vector_source.ARGUMENTS + splat_source.LIMITS
    return start + state + head + _filled(vector_source.TILES, BODY=body)


FORWARD = _kernel(
    "struct Block { vec T, red, green, blue, dist; };",
    "",
    _splats("", _COMPOSITE, BEFORE="", STRIP_END="", STRIP="", AFTER=_FEATURES) + _IMAGE,
)
_GRADIENTS = _kernel(
    backward_source.STATE,
    backward_source.HEAD,
    _filled(
        vector_source.EACH_ROW,
        BEFORE=backward_source.LOAD_BEGIN,
        ROW=backward_source.LOAD,
        AFTER=backward_source.LOAD_END,
    )
    + _splats(
        "__builtin_prefetch(partials_ + (long long)indices_[2 * ahead + 1] * stride, 1);",
        backward_source.COMPOSITE,
        BEFORE=backward_source.BEFORE,
        STRIP_END=backward_source.STRIP_END,
        STRIP=backward_source.STRIP,
        AFTER=backward_source.AFTER,
    ),
)
BACKWARD = "constexpr bool ABSOLUTE = false;" + _GRADIENTS
ABSOLUTE = "constexpr bool ABSOLUTE = true;" + _GRADIENTS  # absolute gradients, too

LANES = _filled(vector_source.VECTORS, **_SIZES) + "*(int*)lanes.data = LANES;"

PREFETCH = r"""__builtin_prefetch((const float*)array.data + index);"""

# The index of the next work item, for workers that share `counters`.
NEXT_WORK_ITEM = (
    r"""return __atomic_fetch_add((int*)counters.data + counter, 1, __ATOMIC_RELAXED);"""
)

# Address of a function that runs a queue of compiled kernels; each thread of a pool calls it.
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
