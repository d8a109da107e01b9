"""C++ of the skinning of points and rotations, of products of quaternions, and of their gradients.

The weighted mean of a point's joints is one sum of vectors of 16: twelve numbers of each joint's
transform and four of its quaternion. A work item is CHUNK points; gradients of the joints are
summed apart for each, and these sums added up by torch, so that results do not depend on the number
of cores. Casts are written (float)(x), since `float(x)` is a macro of Warp. The arguments are
described in `kernels`.
"""

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
