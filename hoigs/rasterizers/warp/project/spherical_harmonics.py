# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Spherical harmonics of degree 0 to 3 with derivatives, as Warp functions.

Order and signs are those of `hoigs.core.maths.spherical_harmonics`, whose constants are used.
"""

from hoigs.core.maths import spherical_harmonics as sh
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.records import VEC3

Vec16 = wp.types.vector(16, wp.float32)

C0 = wp.constant(sh.C0)
C1 = wp.constant(sh.C1)
C20 = wp.constant(sh.C2[0])
C21 = wp.constant(sh.C2[1])
C22 = wp.constant(sh.C2[2])
C30 = wp.constant(sh.C3[0])
C31 = wp.constant(sh.C3[1])
C32 = wp.constant(sh.C3[2])
C33 = wp.constant(sh.C3[3])
C34 = wp.constant(sh.C3[4])
BLACK = wp.constant(sh.BLACK)


@wp.func
def sh_basis(d: wp.vec3, active_bases: int) -> Vec16:
    """The first `active_bases` (1, 4, 9 or 16) basis functions at a unit direction, others 0."""
    x = d[0]
    y = d[1]
    z = d[2]
    b = Vec16()
    b[0] = C0
    if active_bases > 1:
        b[1] = -C1 * y
        b[2] = C1 * z
        b[3] = -C1 * x
    if active_bases > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        b[4] = C20 * x * y
        b[5] = -C20 * y * z
        b[6] = C21 * (2.0 * zz - xx - yy)
        b[7] = -C20 * x * z
        b[8] = C22 * (xx - yy)
        if active_bases > 9:
            b[9] = -C30 * y * (3.0 * xx - yy)
            b[10] = C31 * x * y * z
            b[11] = -C32 * y * (4.0 * zz - xx - yy)
            b[12] = C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            b[13] = -C32 * x * (4.0 * zz - xx - yy)
            b[14] = C34 * z * (xx - yy)
            b[15] = -C30 * x * (xx - 3.0 * yy)
    return b


@wp.func
def sh_direction_gradient(d: wp.vec3, s: Vec16, active_bases: int) -> wp.vec3:
    """Gradient by d of sum_k s_k Y_k(d), the Y_k taken as polynomials in x, y, z."""
    x = d[0]
    y = d[1]
    z = d[2]
    gx = -C1 * s[3]
    gy = -C1 * s[1]
    gz = C1 * s[2]
    if active_bases > 4:
        gx += C20 * y * s[4] - 2.0 * C21 * x * s[6] - C20 * z * s[7] + 2.0 * C22 * x * s[8]
        gy += C20 * x * s[4] - C20 * z * s[5] - 2.0 * C21 * y * s[6] - 2.0 * C22 * y * s[8]
        gz += -C20 * y * s[5] + 4.0 * C21 * z * s[6] - C20 * x * s[7]
    if active_bases > 9:
        xx = x * x
        yy = y * y
        zz = z * z
        gx += (
            -6.0 * C30 * x * y * s[9]
            + C31 * y * z * s[10]
            + 2.0 * C32 * x * y * s[11]
            - 6.0 * C33 * x * z * s[12]
            - C32 * (4.0 * zz - 3.0 * xx - yy) * s[13]
            + 2.0 * C34 * x * z * s[14]
            - 3.0 * C30 * (xx - yy) * s[15]
        )
        gy += (
            -3.0 * C30 * (xx - yy) * s[9]
            + C31 * x * z * s[10]
            - C32 * (4.0 * zz - xx - 3.0 * yy) * s[11]
            - 6.0 * C33 * y * z * s[12]
            + 2.0 * C32 * x * y * s[13]
            - 2.0 * C34 * y * z * s[14]
            + 6.0 * C30 * x * y * s[15]
        )
        gz += (
            C31 * x * y * s[10]
            - 8.0 * C32 * y * z * s[11]
            + C33 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * s[12]
            - 8.0 * C32 * x * z * s[13]
            + C34 * (xx - yy) * s[14]
        )
    return wp.vec3(gx, gy, gz)


# On CUDA a thread fetches all coefficients of a Gaussian at once, four by each load where they
# begin at a multiple of 16 bytes; in a loop, each load would wait for the one before.
@wp.func_native(r"""
    const float* of = (const float*)sh.data + 3ll * row * stored_bases;
    wp::vec_t<3, float> color(0.5f, 0.5f, 0.5f);
#if defined(__CUDA_ARCH__)
    float values[48];
    if (((size_t)of & 15) == 0) {
        #pragma unroll
        for (int i = 0; i < 12; ++i) {
            const float4 four = 4 * i < 3 * active_bases ? ((const float4*)of)[i]
                                                         : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
            values[4 * i] = four.x; values[4 * i + 1] = four.y;
            values[4 * i + 2] = four.z; values[4 * i + 3] = four.w;
        }
    } else {
        #pragma unroll
        for (int i = 0; i < 48; ++i) values[i] = i < 3 * active_bases ? of[i] : 0.0f;
    }
    #pragma unroll
    for (int k = 0; k < 16; ++k)
        #pragma unroll
        for (int j = 0; j < 3; ++j) color[j] += basis[k] * values[3 * k + j];
#else
    for (int k = 0; k < active_bases; ++k)
        for (int j = 0; j < 3; ++j) color[j] += basis[k] * of[3 * k + j];
#endif
    return color;
""")
def sh_sum(sh: VEC3, row: int, stored_bases: int, active_bases: int, basis: Vec16) -> wp.vec3: ...


@wp.func
def sh_color(
    sh: VEC3, row: int, stored_bases: int, active_bases: int, direction: wp.vec3
) -> wp.vec3:
    """0.5 + sum_k sh_k Y_k, before it is clamped at zero."""
    if active_bases == 1:
        return wp.vec3(0.5, 0.5, 0.5) + C0 * sh[row * stored_bases]
    return sh_sum(sh, row, stored_bases, active_bases, sh_basis(direction, active_bases))


@wp.func
def not_negative(color: float) -> float:
    """max(color, 0), as -0 where no gradient passes (`sh.not_negative`): a record has one place."""
    if color < -BLACK:
        return -0.0
    return wp.max(color, 0.0)


@wp.func
def learns(shown: float) -> bool:
    """Whether the gradient passes to a colour that `not_negative` made."""
    return 1.0 / shown >= 0.0  # -infinity for -0


@wp.func
def sh_color_adjoint(
    sh: VEC3, row: int, stored_bases: int, active_bases: int, direction: wp.vec3, v_color: wp.vec3,
    v_sh: VEC3,
) -> wp.vec3:  # fmt: skip
    """Write the gradient of the coefficients; return that of the unit direction."""
    first = row * stored_bases
    basis = sh_basis(direction, active_bases)
    dots = Vec16()
    for k in range(active_bases):
        v_sh[first + k] = basis[k] * v_color
        dots[k] = wp.dot(sh[first + k], v_color)
    if active_bases == 1:
        return wp.vec3(0.0, 0.0, 0.0)
    return sh_direction_gradient(direction, dots, active_bases)
