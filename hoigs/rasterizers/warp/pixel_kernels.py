# mypy: ignore-errors
# ruff: noqa: UP018, RUF046
# Warp's arrays annotate as values, and float(0.0) declares a variable that a loop may change.
"""Kernels that run alike on CUDA and, for testing them, on a CPU.

On CUDA one warp of 32 lanes draws a tile, 16 pixels wide and TILE_ROWS high: a lane owns PIXELS
pixels of one column. For the gradient, each pair's sums go over the lane's pixels, then over the
warp by shuffles, and one lane writes them: neither atomics nor barriers, and the same sums in every
run. On a CPU the lanes run one after the other and each adds its own.
"""

from hoigs.rasterizers.warp.records import (
    F32,
    I32,
    LOG2_OPACITY,
    M_G,
    M_RED,
    M_U,
    M_UU,
    M_UY,
    M_Y,
    M_YY,
    MOMENTS,
    RECORD,
    RED,
    SHEAR,
    A,
    C,
    X,
    Y,
)
from hoigs.rasterizers.warp.runtime import CPU_FLAGS, wp
from hoigs.rasterizers.warp.tile_spans import TILE_WIDTH

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

LANES = 32
PIXELS = 4
TILE_ROWS = LANES // TILE_WIDTH * PIXELS
LANES_C = wp.constant(LANES)
PIXELS_C = wp.constant(PIXELS)
WIDTH_C = wp.constant(TILE_WIDTH)
STEP = wp.constant(LANES // TILE_WIDTH)  # rows between a lane's pixels
TILE_ROWS_C = wp.constant(TILE_ROWS)
RECORD_C = wp.constant(RECORD)
MOMENTS_C = wp.constant(MOMENTS)
Column = wp.types.vector(PIXELS, wp.float32)  # one number for each of a lane's pixels


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1) x += __shfl_xor_sync(0xffffffffu, x, step);
#endif
    return x;
""")
def warp_sum(x: float) -> float:
    """Sum over the warp, in every lane; on a CPU x itself."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, x != 0) != 0;
#else
    return x != 0;
#endif
""")
def warp_any(x: int) -> bool: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return exp2f(x);
#else
    return wp::exp(x * 0.693147180559945309f);
#endif
""")
def exp2(x: float) -> float: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return lane == 0;
#else
    return true;
#endif
""")
def writes(lane: int) -> bool:
    """Whether this lane writes what `warp_sum` gave."""
    ...


@wp.func
def add(array: F32, index: int, value: float):
    array[index] = array[index] + value


@wp.func
def channels_of(records: F32, features: F32, row: int, block: int, channels: int) -> wp.vec4:
    """Colour and depth for block 0, then four features a block."""
    if block == 0:
        r = row * RECORD_C + RED
        return wp.vec4(records[r], records[r + 1], records[r + 2], records[r + 3])
    return four(features, row, block, channels)


@wp.func
def four(array: F32, item: int, block: int, channels: int) -> wp.vec4:
    """The four channels of a feature block of one item (a Gaussian or a pixel)."""
    v = wp.vec4(0.0, 0.0, 0.0, 0.0)
    begin = 4 * (block - 1)
    for j in range(4):
        if begin + j < channels:
            v[j] = array[item * channels + begin + j]
    return v


@wp.kernel
def forward_pixels(
    tiles: int,
    across: int,
    width: int,
    height: int,
    max_alpha: float,
    log2_min_alpha: float,
    min_transmittance: float,  # negative: never stop
    records: F32,
    pairs: I32,
    offsets: I32,
    features: F32,  # [N, channels]
    channels: int,
    background: F32,  # [3] with stride 0, or [H, W, 3] with stride 3
    background_stride: int,
    color: F32,
    alpha: F32,
    depth: F32,
    extra: F32,  # [H, W, channels]
    base: int,
    count: int,
):
    thread = wp.tid() + base
    if thread >= count:
        return
    tile = thread // LANES_C
    lane = thread % LANES_C
    x = (tile % across) * WIDTH_C + lane % WIDTH_C
    y = (tile // across) * TILE_ROWS_C + lane // WIDTH_C
    begin = offsets[tile]
    for block in range(1 + (channels + 3) // 4):
        T = Column()
        a0 = Column()
        a1 = Column()
        a2 = Column()
        a3 = Column()
        for i in range(PIXELS_C):
            T[i] = wp.where(x < width and y + i * STEP < height, 1.0, -1.0)
        for k in range(begin, offsets[tile + 1]):
            if (k - begin) % 16 == 15:
                running = int(0)
                for i in range(PIXELS_C):
                    if T[i] > 0.0:
                        running = 1
                if not warp_any(running):
                    break
            row = pairs[2 * k]
            r = row * RECORD_C
            c = channels_of(records, features, row, block, channels)
            dx = float(x) + 0.5 - records[r + X]
            dy0 = float(y) + 0.5 - records[r + Y]
            for i in range(PIXELS_C):
                dy = dy0 + float(i * STEP)
                u = dx - records[r + SHEAR] * dy
                exponent = records[r + LOG2_OPACITY] - records[r + C] * dy * dy
                exponent -= records[r + A] * u * u
                if exponent >= log2_min_alpha and T[i] > 0.0:
                    weight = T[i] * wp.min(exp2(exponent), max_alpha)
                    rest = T[i] - weight
                    if rest > min_transmittance:
                        T[i] = rest
                        a0[i] = a0[i] + weight * c[0]
                        a1[i] = a1[i] + weight * c[1]
                        a2[i] = a2[i] + weight * c[2]
                        a3[i] = a3[i] + weight * c[3]
                    else:
                        T[i] = -T[i]
        for i in range(PIXELS_C):
            if x < width and y + i * STEP < height:
                p = (y + i * STEP) * width + x
                if block == 0:
                    left = wp.abs(T[i])
                    b = p * background_stride
                    color[3 * p] = a0[i] + left * background[b]
                    color[3 * p + 1] = a1[i] + left * background[b + 1]
                    color[3 * p + 2] = a2[i] + left * background[b + 2]
                    depth[p] = a3[i]
                    alpha[p] = 1.0 - left
                else:
                    sums = wp.vec4(a0[i], a1[i], a2[i], a3[i])
                    for j in range(4):
                        if 4 * (block - 1) + j < channels:
                            extra[p * channels + 4 * (block - 1) + j] = sums[j]


@wp.kernel
def backward_pixels(
    tiles: int,
    across: int,
    width: int,
    height: int,
    max_alpha: float,
    log2_min_alpha: float,
    min_transmittance: float,
    records: F32,
    pairs: I32,
    offsets: I32,
    features: F32,
    channels: int,
    background: F32,
    background_stride: int,
    color: F32,
    alpha: F32,
    depth: F32,
    extra: F32,
    v_color: F32,
    v_alpha: F32,
    v_depth: F32,
    v_extra: F32,
    partials: F32,  # [pairs, MOMENTS + channels], zero
    base: int,
    count: int,
):
    thread = wp.tid() + base
    if thread >= count:
        return
    tile = thread // LANES_C
    lane = thread % LANES_C
    x = (tile % across) * WIDTH_C + lane % WIDTH_C
    y = (tile // across) * TILE_ROWS_C + lane // WIDTH_C
    begin = offsets[tile]
    for block in range(1 + (channels + 3) // 4):
        T = Column()
        S = Column()  # what the splats behind still add: sum of w (channels . v + veil)
        veil = Column()  # gradient of alpha, and of the background that it hides
        v0 = Column()
        v1 = Column()
        v2 = Column()
        v3 = Column()
        for i in range(PIXELS_C):
            T[i] = -1.0
            if x < width and y + i * STEP < height:
                T[i] = 1.0
                p = (y + i * STEP) * width + x
                if block == 0:
                    b = p * background_stride
                    back = wp.vec3(background[b], background[b + 1], background[b + 2])
                    shown = wp.vec3(color[3 * p], color[3 * p + 1], color[3 * p + 2])
                    v = wp.vec3(v_color[3 * p], v_color[3 * p + 1], v_color[3 * p + 2])
                    v0[i] = v[0]
                    v1[i] = v[1]
                    v2[i] = v[2]
                    v3[i] = v_depth[p]
                    veil[i] = v_alpha[p] - wp.dot(back, v)
                    S[i] = wp.dot(shown - back, v) + depth[p] * v_depth[p] + alpha[p] * v_alpha[p]
                else:
                    w = four(v_extra, p, block, channels)
                    v0[i] = w[0]
                    v1[i] = w[1]
                    v2[i] = w[2]
                    v3[i] = w[3]
                    S[i] = wp.dot(four(extra, p, block, channels), w)
        for k in range(begin, offsets[tile + 1]):
            if (k - begin) % 16 == 15:
                running = int(0)
                for i in range(PIXELS_C):
                    if T[i] > 0.0:
                        running = 1
                if not warp_any(running):
                    break
            row = pairs[2 * k]
            r = row * RECORD_C
            c = channels_of(records, features, row, block, channels)
            dx = float(x) + 0.5 - records[r + X]
            dy0 = float(y) + 0.5 - records[r + Y]
            hit = int(0)
            g = float(0.0)
            gu = float(0.0)
            gy = float(0.0)
            guu = float(0.0)
            guy = float(0.0)
            gyy = float(0.0)
            s0 = float(0.0)
            s1 = float(0.0)
            s2 = float(0.0)
            s3 = float(0.0)
            for i in range(PIXELS_C):
                dy = dy0 + float(i * STEP)
                u = dx - records[r + SHEAR] * dy
                exponent = records[r + LOG2_OPACITY] - records[r + C] * dy * dy
                exponent -= records[r + A] * u * u
                if exponent >= log2_min_alpha and T[i] > 0.0:
                    raw = exp2(exponent)
                    opaque = wp.min(raw, max_alpha)
                    weight = T[i] * opaque
                    rest = T[i] - weight
                    if rest > min_transmittance:
                        hit = 1
                        value = c[0] * v0[i] + c[1] * v1[i] + c[2] * v2[i] + c[3] * v3[i] + veil[i]
                        S[i] = S[i] - weight * value
                        if raw <= max_alpha:
                            clear = wp.max(1.0 - opaque, 1.0e-7)
                            slope = opaque * (T[i] * value - S[i] / clear)
                            g += slope
                            gu += slope * u
                            gy += slope * dy
                            guu += slope * u * u
                            guy += slope * u * dy
                            gyy += slope * dy * dy
                        s0 += weight * v0[i]
                        s1 += weight * v1[i]
                        s2 += weight * v2[i]
                        s3 += weight * v3[i]
                        T[i] = rest
                    else:
                        T[i] = -T[i]
            if warp_any(hit):
                g = warp_sum(g)
                gu = warp_sum(gu)
                gy = warp_sum(gy)
                guu = warp_sum(guu)
                guy = warp_sum(guy)
                gyy = warp_sum(gyy)
                sums = wp.vec4(warp_sum(s0), warp_sum(s1), warp_sum(s2), warp_sum(s3))
                if writes(lane):
                    o = pairs[2 * k + 1] * (MOMENTS_C + channels)
                    add(partials, o + M_G, g)
                    add(partials, o + M_U, gu)
                    add(partials, o + M_Y, gy)
                    add(partials, o + M_UU, guu)
                    add(partials, o + M_UY, guy)
                    add(partials, o + M_YY, gyy)
                    for j in range(4):
                        if block == 0:
                            add(partials, o + M_RED + j, sums[j])
                        elif 4 * (block - 1) + j < channels:
                            add(partials, o + MOMENTS_C + 4 * (block - 1) + j, sums[j])
