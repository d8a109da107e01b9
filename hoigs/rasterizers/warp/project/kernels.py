# mypy: ignore-errors
# ruff: noqa: UP018
# Warp's arrays annotate as values, and float(0.0) declares a variable that a loop may change.
"""Projection kernels for CPU and CUDA, one thread per Gaussian: raw fields to records, and the
adjoint from partial gradients to the raw fields."""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.project import geometry
from hoigs.rasterizers.warp.project.geometry import pose_rotation, pose_translation
from hoigs.rasterizers.warp.project.spherical_harmonics import (
    learns,
    not_negative,
    sh_color,
    sh_color_adjoint,
)
from hoigs.rasterizers.warp.records import (
    BLUE,
    F32,
    HALF_LOG2E,
    HALF_WIDTH,
    I32,
    M_G,
    M_RED,
    M_U,
    M_UU,
    M_UY,
    M_Y,
    M_YY,
    MOMENTS,
    POSE,
    REACH_SLACK,
    RECORD,
    RED,
    SLOPE,
    U8,
    VEC3,
    VEC4,
    C,
    X,
)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS, "max_unroll": 4})

RECORD_C = wp.constant(RECORD)
MOMENTS_C = wp.constant(MOMENTS)
POSE_C = wp.constant(POSE)


@wp.func
def camera_center(world_to_camera: F32) -> wp.vec3:
    return -(wp.transpose(pose_rotation(world_to_camera)) * pose_translation(world_to_camera))


@wp.func
def row_is_finite(
    row: int, mean: wp.vec3, quat: wp.vec4, log_scale: wp.vec3, logit: float, sh: VEC3,
    stored_bases: int, active_bases: int, color: wp.vec3, features: F32, channels: int,
    offset: wp.vec2,
) -> bool:  # fmt: skip
    # 0 * value is 0 for every finite value and NaN for all others; one test at the end. A logit may
    # be infinite: an opacity of 0 or 1.
    zero = (
        0.0 * (mean[0] + mean[1] * 0.0 + mean[2] * 0.0)
        + (quat[0] * 0.0 + quat[1] * 0.0 + quat[2] * 0.0 + quat[3] * 0.0)
        + (log_scale[0] * 0.0 + log_scale[1] * 0.0 + log_scale[2] * 0.0)
        + (offset[0] * 0.0 + offset[1] * 0.0)
    )
    # a finite colour proves its coefficients finite, and takes less time than looking at each
    zeros = 0.0 * color
    first = active_bases
    if zeros[0] + zeros[1] + zeros[2] != 0.0:
        zeros = wp.vec3(0.0, 0.0, 0.0)
        first = 0
    for k in range(first, stored_bases):
        zeros += 0.0 * sh[row * stored_bases + k]
    for k in range(channels):
        zero += 0.0 * features[row * channels + k]
    return zero + zeros[0] + zeros[1] + zeros[2] == 0.0 and not wp.isnan(logit)


@wp.func
def log2_sigmoid(logit: float) -> float:
    return -wp.log2(1.0 + wp.exp(-logit))


# On CUDA by one store: a record is a cache line, which stores of single floats write in parts.
@wp.func_native("""
    float* to = (float*)records.data + at;
#if defined(__CUDA_ARCH__)
    *(float4*)to = make_float4(first, second, third, fourth);
#else
    to[0] = first;
    to[1] = second;
    to[2] = third;
    to[3] = fourth;
#endif
""")
def put_four(records: F32, at: int, first: float, second: float, third: float, fourth: float): ...


def make_kernels(module, onto_screen, is_regular, shape_adjoint):
    """`project` and `project_adjoint` of one kind of camera, as kernels of a Warp module.

    Args:
        onto_screen, is_regular, shape_adjoint: Warp functions as `geometry` has them.
    """

    def project(
        means: VEC3, quats: VEC4, log_scales: VEC3, opacity_logits: F32, sh: VEC3,
        stored_bases: int,  # active_bases in sh
        active_bases: int,  # active_bases to use
        features: F32, channels: int,
        offsets: F32,  # empty where none are given
        has_offsets: int,
        subset: U8,  # empty when all are drawn
        has_subset: int, K: F32, world_to_camera: F32, width: int, height: int, near: float,
        low_pass: float, antialiased: int, min_alpha: float,
        smallest_alpha: float,  # min_alpha, but not 0
        records: F32, means2d: F32, depths: F32,
        drawn_depths: F32,  # negative where nothing is drawn
        radii: F32, base: int, count: int,
    ):  # fmt: skip
        row = wp.tid() + base
        if row >= count:
            return
        r = row * RECORD_C
        records[r + HALF_WIDTH] = -1.0
        means2d[2 * row] = 0.0
        means2d[2 * row + 1] = 0.0
        depths[row] = 0.0
        drawn_depths[row] = -1.0
        radii[row] = 0.0
        if has_subset != 0:  # noqa: SIM102  older Warps' `and` evaluates both sides
            if subset[row] == wp.uint8(0):
                return
        mean = means[row]
        quat = quats[row]
        log_scale = log_scales[row]
        logit = opacity_logits[row]
        offset = wp.vec2(0.0, 0.0)
        if has_offsets != 0:
            offset = wp.vec2(offsets[2 * row], offsets[2 * row + 1])
        scale = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
        s = onto_screen(mean, quat, scale, offset, K, world_to_camera, width, height, low_pass)
        if not is_regular(s, quat, scale, near):
            return
        log2_opacity = log2_sigmoid(logit)
        if antialiased != 0:
            log2_opacity += 0.5 * (wp.log2(wp.dot(s.normal, s.normal)) - wp.log2(s.det))
        reach = (log2_opacity - wp.log2(smallest_alpha)) / HALF_LOG2E  # 2 ln(opacity / min_alpha)
        half_width = wp.sqrt(reach * s.xx)
        half_height = wp.sqrt(reach * s.yy)
        hidden = (
            reach < 0.0
            or s.u + half_width < 0.0
            or s.u - half_width > float(width)
            or s.v + half_height < 0.0
            or s.v - half_height > float(height)
        )
        if hidden and min_alpha > 0.0:
            return
        direction = wp.vec3(0.0, 0.0, 0.0)
        if active_bases > 1:
            direction = wp.normalize(mean - camera_center(world_to_camera))
        color = sh_color(sh, row, stored_bases, active_bases, direction)
        if not row_is_finite(
            row,
            mean,
            quat,
            log_scale,
            logit,
            sh,
            stored_bases,
            active_bases,
            color,
            features,
            channels,
            offset,
        ):
            return

        means2d[2 * row] = s.u
        means2d[2 * row + 1] = s.v
        depths[row] = s.cam[2]
        half_gap = 0.5 * (s.xx - s.yy)
        largest = 0.5 * (s.xx + s.yy) + wp.sqrt(half_gap * half_gap + s.xy * s.xy)
        radii[row] = wp.ceil(3.0 * wp.sqrt(largest))
        if hidden:  # drawn by the rules (min_alpha is 0), but nowhere visible in float32
            return

        reach = reach * REACH_SLACK
        half_width = wp.sqrt(reach * s.xx)
        drawn_depths[row] = s.cam[2]
        put_four(records, r + X, s.u, s.v, HALF_LOG2E * s.yy / s.det, s.xy / s.yy)
        red = not_negative(color[0])
        green = not_negative(color[1])
        put_four(records, r + C, HALF_LOG2E / s.yy, log2_opacity, red, green)
        half_height = wp.sqrt(reach * s.yy)
        put_four(records, r + BLUE, not_negative(color[2]), s.cam[2], half_width, half_height)
        waist_y = wp.sqrt(reach * s.det / s.xx)
        waist_x = wp.sqrt(reach * s.det / s.yy)
        inverse = 1.0 / wp.max(half_width, 1.0e-6)
        put_four(records, r + SLOPE, s.xy / s.xx, waist_y, waist_x, inverse)

    def project_adjoint(
        means: VEC3, quats: VEC4, log_scales: VEC3, opacity_logits: F32, sh: VEC3,
        stored_bases: int,  # 0, both, after `harmonics_adjoint`: v_sh is there, and in v_log_scales
        active_bases: int,  # stands the gradient of the camera centre in place of the colour's
        channels: int, offsets: F32, has_offsets: int,
        K: F32, world_to_camera: F32, width: int, height: int, low_pass: float, antialiased: int,
        records: F32,
        first_partial: I32,  # index in `partials` of a Gaussian's first
        partial_counts: I32,  # how many it has
        summed: int,  # 1 where their sums stand where `gather_kernels` puts them instead
        partials: F32, v_means: VEC3, v_quats: VEC4, v_log_scales: VEC3, v_opacity_logits: F32,
        v_sh: VEC3,
        v_offsets: F32,  # empty where not asked for
        wants_offsets: int, v_features: F32, v_absolutes: F32,
        absolutes: int,  # how many numbers v_absolutes has of each Gaussian: 0 or 2
        v_pose: F32,  # empty when the pose needs no gradient
        has_pose: int,  # 0, or how many rows v_pose has
        base: int, count: int,
    ):  # fmt: skip
        row = wp.tid() + base
        if row >= count:
            return
        stride = MOMENTS_C + channels + absolutes
        partial_count = partial_counts[row]
        begin = 0
        if summed == 0:
            begin = first_partial[row] * stride
        if summed == 0 or partial_count == 0:
            for k in range(channels):
                total = float(0.0)
                for j in range(partial_count):
                    total += partials[begin + j * stride + MOMENTS_C + k]
                v_features[row * channels + k] = total
            for k in range(absolutes):
                total = float(0.0)
                for j in range(partial_count):
                    total += partials[begin + j * stride + MOMENTS_C + channels + k]
                v_absolutes[row * absolutes + k] = total
        if has_pose != 0:
            for k in range(POSE_C):
                v_pose[row * POSE_C + k] = 0.0
        zero3 = wp.vec3(0.0, 0.0, 0.0)
        if partial_count == 0:
            for k in range(stored_bases):
                v_sh[row * stored_bases + k] = zero3
            v_means[row] = zero3
            v_quats[row] = wp.vec4(0.0, 0.0, 0.0, 0.0)
            v_log_scales[row] = zero3
            v_opacity_logits[row] = 0.0
            if wants_offsets != 0:
                v_offsets[2 * row] = 0.0
                v_offsets[2 * row + 1] = 0.0
            return

        g = float(0.0)
        gu = float(0.0)
        gy = float(0.0)
        guu = float(0.0)
        guy = float(0.0)
        gyy = float(0.0)
        v_color = wp.vec3(0.0, 0.0, 0.0)
        v_depth = float(0.0)
        if summed != 0:
            first = v_means[row]
            second = v_quats[row]
            g = first[0]
            gu = first[1]
            gy = first[2]
            guu = second[0]
            guy = second[1]
            gyy = second[2]
            v_color = v_log_scales[row]
            v_depth = second[3]
        else:
            for j in range(partial_count):
                p = begin + j * stride
                g += partials[p + M_G]
                gu += partials[p + M_U]
                gy += partials[p + M_Y]
                guu += partials[p + M_UU]
                guy += partials[p + M_UY]
                gyy += partials[p + M_YY]
                v_color += wp.vec3(
                    partials[p + M_RED], partials[p + M_RED + 1], partials[p + M_RED + 2]
                )
                v_depth += partials[p + M_RED + 3]

        mean = means[row]
        quat = quats[row]
        log_scale = log_scales[row]
        offset = wp.vec2(0.0, 0.0)
        if has_offsets != 0:
            offset = wp.vec2(offsets[2 * row], offsets[2 * row + 1])
        scale = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
        s = onto_screen(mean, quat, scale, offset, K, world_to_camera, width, height, low_pass)

        # ln alpha = ln opacity - (yy / det u^2 + dy^2 / yy) / 2,  u = dx - xy / yy dy
        wide = s.yy / s.det
        shear = s.xy / s.yy
        v_shear = wide * guy
        v_yy = -0.5 * guu / s.det + 0.5 * gyy / (s.yy * s.yy) - v_shear * shear / s.yy
        v_xy = v_shear / s.yy
        v_det = 0.5 * wide * guu / s.det
        v_u = wide * gu
        v_v = gy / s.yy - shear * v_u
        # det = |m0 x m1|^2 + low_pass (m0.m0 + m1.m1) + low_pass^2
        v_square = v_det  # by |m0 x m1|^2
        if antialiased != 0:  # ln opacity has ln |m0 x m1| - ln det / 2
            v_det -= 0.5 * g / s.det
            v_square = v_det + 0.5 * g / wp.dot(s.normal, s.normal)
        raw = shape_adjoint(
            s, quat, scale, mean, K, world_to_camera, low_pass, v_u, v_v, v_depth, v_det, v_square,
            v_xy, v_yy, v_pose, has_pose, row,
        )  # fmt: skip

        v_center = v_color  # after `harmonics_adjoint`
        if active_bases > 0:
            for k in range(3):
                if not learns(records[row * RECORD_C + RED + k]):
                    v_color[k] = 0.0
            for k in range(active_bases, stored_bases):
                v_sh[row * stored_bases + k] = zero3
            v_center = zero3
            if active_bases > 1:
                toward = mean - camera_center(world_to_camera)
                distance = wp.length(toward)
                direction = toward / distance
                v_direction = sh_color_adjoint(
                    sh, row, stored_bases, active_bases, direction, v_color, v_sh
                )
                v_center = (wp.dot(direction, v_direction) * direction - v_direction) / distance
            else:
                sh_color_adjoint(sh, row, stored_bases, active_bases, zero3, v_color, v_sh)

        v_means[row] = raw.mean - v_center
        v_quats[row] = raw.quat
        v_log_scales[row] = raw.log_scale
        v_opacity_logits[row] = g / (1.0 + wp.exp(opacity_logits[row]))
        if wants_offsets != 0:
            v_offsets[2 * row] = v_u
            v_offsets[2 * row + 1] = v_v
        if has_pose != 0:
            p = row * POSE_C
            for k in range(3):
                for j in range(3):
                    v_pose[p + 3 * k + j] = raw.rotation[k, j]
                v_pose[p + 9 + k] = raw.translation[k]
                v_pose[p + 12 + k] = v_center[k]

    return tuple(
        wp.Kernel(function, key=function.__name__, module=module)
        for function in (project, project_adjoint)
    )


project, project_adjoint = make_kernels(
    wp.get_module(__name__), geometry.onto_screen, geometry.is_regular, geometry.shape_adjoint
)
