"""C++ of the native CPU kernels: the backward of compositing, front to back.

S is what the splats not yet passed still add to the loss's gradient, a scalar a pixel: the sum over
them of w (colour . v_colour + ...). It starts from the finished image, so that no list of the
splats at each pixel is needed. With `value` the splat's own term, `slope` is dloss / d(ln alpha) =
alpha (T value - S / (1 - alpha)); its moments in u and y are what `project_adjoint` needs.

Each pass has the part of the slope that its own channels bring. Absolute gradients (ABSOLUTE) need
a pixel's slope from all channels together: there the first pass has all of it, and later passes sum
only the gradients of their features.
"""

STATE = r"""
    struct Block { vec T, S, red, green, blue, dist; };  // the colours: of the image's gradient
    vec net_v_alpha[2 * BLOCKS];  // gradient of alpha, less what the background loses by it
    vec v_weight_blocks[2 * BLOCKS];
"""

HEAD = r"""
    const float* v_color_ = (const float*)v_color.data;
    const float* v_alpha_ = (const float*)v_alpha.data;
    const float* v_depth_ = (const float*)v_depth.data;
    const float* v_feature_image_ = (const float*)v_feature_image.data;
    float* partials_ = (float*)partials.data;
    const int stride = 10 + channels + (ABSOLUTE ? 2 : 0);
    auto of_block = [&](const float* image, int k, int x, int y) -> vec {  // a channel of a block
        vec values = same(0.0f);
        for (int i = 0; i < LANES; ++i)
            if (x + i / HIGH < width && y + i % HIGH < height)
                lane_of(values, i) =
                    image[((long long)(y + i % HIGH) * width + x + i / HIGH) * channels + k];
        return values;
    };
    // rows from the middle of a range of blocks, and their square
    float off_[4 * BLOCKS], off_squared_[4 * BLOCKS];
    for (int i = 0; i < 4 * BLOCKS; ++i) {
        off_[i] = 0.5f * HIGH * (float)(i - 2 * BLOCKS);
        off_squared_[i] = off_[i] * off_[i];
    }
    const vec lift = lane_y - 0.5f * (HIGH - 1);  // rows from the middle of a block
    auto reciprocal = [](vec x) -> vec {
#if defined(__AVX512F__)
        // 14 bits and one Newton step, relative error 1e-7: a division holds the core up
        const vec r = __builtin_ia32_rcp14ps512_mask(x, x, (unsigned short)-1);
        return r * (2.0f - x * r);
#else
        return 1.0f / x;
#endif
    };
    auto total = [](vec x) -> float {
#if defined(__AVX512F__)
        const f8 h = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7)
            + __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
#else
        const f8 h = x;
#endif
        const f4 q = __builtin_shufflevector(h, h, 0, 1, 2, 3)
            + __builtin_shufflevector(h, h, 4, 5, 6, 7);
        return (q[0] + q[2]) + (q[1] + q[3]);
    };
"""

# The image and its gradient into blocks: 0 to 2 colour, 3 to 5 its gradient, 6 to 8 background,
# 9 and 10 alpha, 11 and 12 depth.
LOAD_BEGIN = r"""
    vec in[13], image_features[PASS_CHANNELS];
    if (columns < 8 || HIGH * (b + 1) > high) {
        for (int j = 0; j < 13; ++j) in[j] = same(0.0f);
        for (int j = 0; j < n_features; ++j) image_features[j] = same(0.0f);
    }
"""
LOAD = r"""
    for (int i = 0; i < columns; ++i) {
        const int lane = HIGH * i + h;
        const float* back = background_ + (o + i) * background_stride;
        for (int j = 0; j < 3; ++j) {
            lane_of(in[j], lane) = color_[3 * (o + i) + j];
            lane_of(in[3 + j], lane) = v_color_[3 * (o + i) + j];
            lane_of(in[6 + j], lane) = back[j];
        }
        lane_of(in[9], lane) = alpha_[o + i];
        lane_of(in[10], lane) = v_alpha_[o + i];
        lane_of(in[11], lane) = depth_[o + i];
        lane_of(in[12], lane) = v_depth_[o + i];
        for (int j = 0; j < n_features; ++j) {
            const long long e = (o + i) * channels + pass + j;
            lane_of(image_features[j], lane) = feature_image_[e];
            lane_of(feature_blocks[j][at], lane) = v_feature_image_[e];
        }
    }
"""
LOAD_END = r"""
    net_v_alpha[at] = same(0.0f);
    if (pass == 0) {
        p.red = in[3];
        p.green = in[4];
        p.blue = in[5];
        p.dist = in[12];
        const vec behind = in[3] * in[6] + in[4] * in[7] + in[5] * in[8];
        net_v_alpha[at] = in[10] - behind;
        p.S = in[0] * in[3] + in[1] * in[4] + in[2] * in[5] - behind
            + in[9] * in[10] + in[11] * in[12];
    }
    for (int j = 0; j < n_features && (pass == 0 || !ABSOLUTE); ++j)
        p.S += image_features[j] * feature_blocks[j][at];
    for (int k = PASS_CHANNELS; ABSOLUTE && pass == 0 && k < channels; ++k)
        p.S += of_block(feature_image_, k, X + 8 * s, Y + HIGH * b)
            * of_block(v_feature_image_, k, X + 8 * s, Y + HIGH * b);
"""

# Moments are taken about the middle row of the splat in this tile and along the slanted line there:
# the shift from them to u and dy is then at most a tile's width, so little cancels.
BEFORE = r"""
    vec m0[2], m1[2], m2[2], r0 = same(0.0f), r1 = r0, r2 = r0, r3 = r0;
    int from = first[0], upto = last[0];
    if (first[0] > last[0] || (first[1] <= last[1] && first[1] < from))
        from = first[1];
    if (last[1] > upto) upto = last[1];
    const float middle = 0.5f * HIGH * (float)(from + upto + 1) - cy;
    const float* off = off_ + 2 * BLOCKS - from - upto;
    const float* off_squared = off_squared_ + 2 * BLOCKS - from - upto;
    const vec* v_weight = net_v_alpha;  // what each unit of weight brings besides colour
    if (n_features > 0 && (pass == 0 || !ABSOLUTE)) {
        v_weight = v_weight_blocks;
        for (int s = 0; s < 2; ++s)
            for (int b = s * BLOCKS + first[s]; b <= s * BLOCKS + last[s]; ++b) {
                v_weight_blocks[b] = net_v_alpha[b];
                for (int j = 0; j < n_features; ++j)
                    v_weight_blocks[b] += f[j] * feature_blocks[j][b];
                for (int k = PASS_CHANNELS; ABSOLUTE && k < channels; ++k)
                    v_weight_blocks[b] += f[k]
                        * of_block(v_feature_image_, k, X + 8 * s, Y + HIGH * (b - s * BLOCKS));
            }
    }
    vec absolute_x = same(0.0f), absolute_y = absolute_x;
"""
STRIP = "vec g0 = same(0.0f), g1 = g0, g2 = g0;"
COMPOSITE = r"""
    vec value = g[6] * p.red + v_weight[s * BLOCKS + b];
    value += g[7] * p.green;
    value += g[8] * p.blue;
    value += g[9] * p.dist;
    r0 += weight * p.red;
    r1 += weight * p.green;
    r2 += weight * p.blue;
    r3 += weight * p.dist;
    p.S -= weight * value;
    vec slope = p.S * reciprocal(1.0f - opaque);
    slope = opaque * (before * value - slope);
    slope = only(slope, drawn & (opaque < ceiling));
    g0 += slope;
    g1 += slope * off[2 * b];
    g2 += slope * off_squared[2 * b];
    if (ABSOLUTE) {
        const vec rise = lane_y + ((float)(HIGH * b) + 0.5f - cy);
        const vec along = slope * g[2] * (dx - shear * rise);
        const vec across = slope * c * rise - shear * along;
        absolute_x += (vec)((ivec)along & ~SIGN);
        absolute_y += (vec)((ivec)across & ~SIGN);
    }
"""
STRIP_END = r"""
    m0[s] = g0;
    m1[s] = g1 + lift * g0;
    m2[s] = g2 + lift * (2.0f * g1 + lift * g0);
"""
AFTER = r"""
    float* o = partials_ + (long long)indices_[2 * (batch + n) + 1] * stride;
    const vec u0 = lane_x - (cx + shear * middle), u1 = u0 + 8.0f;
    const vec mu0 = m0[0] * u0, mu1 = m0[1] * u1;
    const float m = total(m0[0] + m0[1]), mt = total(m1[0] + m1[1]);
    const float mtt = total(m2[0] + m2[1]), mu = total(mu0 + mu1);
    const float muu = total(mu0 * u0 + mu1 * u1);
    const float mut = total(m1[0] * u0 + m1[1] * u1);
    const float gu = mu - shear * mt;
    o[0] += m;
    o[1] += gu;
    o[2] += mt + middle * m;
    o[3] += muu - 2.0f * shear * mut + shear * shear * mtt;
    o[4] += mut - shear * mtt + middle * gu;
    o[5] += mtt + 2.0f * middle * mt + middle * middle * m;
    if (pass == 0) {
        o[6] = total(r0);
        o[7] = total(r1);
        o[8] = total(r2);
        o[9] = total(r3);
    }
    if (ABSOLUTE && pass == 0) {
        constexpr float TWO_LN2 = 1.38629436f;
        o[10 + channels] = TWO_LN2 * total(absolute_x);
        o[11 + channels] = TWO_LN2 * total(absolute_y);
    }
    for (int j = 0; j < n_features; ++j) {
        vec sum = same(0.0f);
        for (int s = 0; s < 2; ++s)
            for (int b = s * BLOCKS + first[s]; b <= s * BLOCKS + last[s]; ++b)
                sum += weights[b] * feature_blocks[j][b];
        o[10 + pass + j] = total(sum);
    }
"""
