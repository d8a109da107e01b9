"""C++ of a layer relu(x W^T + b) and of its gradients, for vectors of 16 floats.

A product is made of tiles of 8 rows by 3 vectors, which stay in registers while they are summed.
The backward pass takes BLOCK rows at a time: the masked upstream gradient and x are copied to where
all tiles of the block find them in the cache. Gradients of W and b are summed apart for every CHUNK
rows, and these sums added up by torch, so that results do not depend on the number of cores. Casts
are written (float)(x), since `float(x)` is a macro of Warp. The arguments are described in
`kernels`.
"""

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
