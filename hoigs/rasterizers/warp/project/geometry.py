# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""EWA projection of one Gaussian and its adjoint, as Warp functions.

The rules, names and limits are those at the head of `hoigs.core.maths.projection`.
"""

from hoigs.core.maths import projection as rules
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.records import F32

LIMIT = wp.constant(rules.LIMIT)
MAX_VARIANCE = wp.constant(rules.MAX_VARIANCE)
MIN_DETERMINANT = wp.constant(rules.MIN_DETERMINANT)
SMALLEST_QUAT = wp.constant(rules.QUAT_NORMS[0])
LARGEST_QUAT = wp.constant(rules.QUAT_NORMS[1])


@wp.struct
class Screen:
    """One Gaussian on screen, with what the adjoint needs again."""

    cam: wp.vec3  # centre in camera space
    u: float
    v: float
    slope_x: float  # x / z, y / z after clamping
    slope_y: float
    free_x: float  # 1 where the clamp lets the gradient through, else 0
    free_y: float
    axes: wp.mat33  # rotation(quat) diag(scale), world
    cam_axes: wp.mat33  # R axes
    m0: wp.vec3  # rows of J R axes
    m1: wp.vec3
    xx: float
    xy: float
    yy: float
    normal: wp.vec3  # m0 x m1, whose length is the area before the low-pass
    det: float


@wp.struct
class Raw:
    """Gradients of one Gaussian's raw geometry and of the pose."""

    mean: wp.vec3
    quat: wp.vec4
    log_scale: wp.vec3
    rotation: wp.mat33
    translation: wp.vec3


@wp.func
def pose_rotation(world_to_camera: F32) -> wp.mat33:
    return wp.mat33(
        world_to_camera[0],
        world_to_camera[1],
        world_to_camera[2],
        world_to_camera[4],
        world_to_camera[5],
        world_to_camera[6],
        world_to_camera[8],
        world_to_camera[9],
        world_to_camera[10],
    )


@wp.func
def pose_translation(world_to_camera: F32) -> wp.vec3:
    return wp.vec3(world_to_camera[3], world_to_camera[7], world_to_camera[11])


@wp.func
def quat_to_matrix(q: wp.vec4) -> wp.mat33:
    """Rotation of a unit quaternion wxyz."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def quat_adjoint(quat: wp.vec4, v: wp.mat33) -> wp.vec4:
    """Gradient by a quaternion, not normalised, of the rotation matrix whose gradient is v."""
    norm = wp.length(quat)
    q = quat / norm
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    unit = 2.0 * wp.vec4(
        x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]),
        -2.0 * x * (v[1, 1] + v[2, 2])
        + y * (v[0, 1] + v[1, 0])
        + z * (v[0, 2] + v[2, 0])
        + w * (v[2, 1] - v[1, 2]),
        x * (v[0, 1] + v[1, 0])
        - 2.0 * y * (v[0, 0] + v[2, 2])
        + z * (v[1, 2] + v[2, 1])
        + w * (v[0, 2] - v[2, 0]),
        x * (v[0, 2] + v[2, 0])
        + y * (v[1, 2] + v[2, 1])
        - 2.0 * z * (v[0, 0] + v[1, 1])
        + w * (v[1, 0] - v[0, 1]),
    )
    return (unit - wp.dot(q, unit) * q) / norm


@wp.func
def onto_screen(
    mean: wp.vec3, quat: wp.vec4, scale: wp.vec3, offset: wp.vec2, K: F32, world_to_camera: F32,
    width: int, height: int, low_pass: float,
) -> Screen:  # fmt: skip
    s = Screen()
    rotation = pose_rotation(world_to_camera)
    s.cam = rotation * mean + pose_translation(world_to_camera)
    fx = K[0]
    fy = K[4]
    cx = K[2]
    cy = K[5]
    inverse_z = 1.0 / s.cam[2]
    x = s.cam[0] * inverse_z
    y = s.cam[1] * inverse_z
    s.u = fx * x + cx + offset[0]
    s.v = fy * y + cy + offset[1]

    margin_x = 0.15 * float(width) / fx
    margin_y = 0.15 * float(height) / fy
    s.slope_x = wp.clamp(x, -(cx / fx + margin_x), (float(width) - cx) / fx + margin_x)
    s.slope_y = wp.clamp(y, -(cy / fy + margin_y), (float(height) - cy) / fy + margin_y)
    s.free_x = wp.where(s.slope_x == x, 1.0, 0.0)
    s.free_y = wp.where(s.slope_y == y, 1.0, 0.0)

    turn = quat_to_matrix(quat / wp.length(quat))
    s.axes = wp.mat33(
        turn[0, 0] * scale[0], turn[0, 1] * scale[1], turn[0, 2] * scale[2],
        turn[1, 0] * scale[0], turn[1, 1] * scale[1], turn[1, 2] * scale[2],
        turn[2, 0] * scale[0], turn[2, 1] * scale[1], turn[2, 2] * scale[2],
    )  # fmt: skip
    s.cam_axes = rotation * s.axes
    a0 = wp.vec3(s.cam_axes[0, 0], s.cam_axes[0, 1], s.cam_axes[0, 2])
    a1 = wp.vec3(s.cam_axes[1, 0], s.cam_axes[1, 1], s.cam_axes[1, 2])
    a2 = wp.vec3(s.cam_axes[2, 0], s.cam_axes[2, 1], s.cam_axes[2, 2])
    s.m0 = fx * inverse_z * (a0 - s.slope_x * a2)
    s.m1 = fy * inverse_z * (a1 - s.slope_y * a2)
    xx = wp.dot(s.m0, s.m0)
    yy = wp.dot(s.m1, s.m1)
    s.normal = wp.cross(s.m0, s.m1)
    s.xy = wp.dot(s.m0, s.m1)
    s.det = wp.dot(s.normal, s.normal) + low_pass * (xx + yy) + low_pass * low_pass
    s.xx = xx + low_pass
    s.yy = yy + low_pass
    return s


@wp.func
def is_regular(s: Screen, quat: wp.vec4, scale: wp.vec3, near: float) -> bool:
    """The culling rules about size and place; every comparison with NaN is false."""
    return fits(s.cam, s.u, s.v, s.xx + s.yy, s.det, quat, scale, near)


@wp.func
def fits(
    cam: wp.vec3, u: float, v: float, trace: float, det: float, quat: wp.vec4, scale: wp.vec3,
    near: float,
) -> bool:  # fmt: skip
    """As `is_regular`, of any camera; trace and det are those of the covariance on the screen."""
    norm = wp.length(quat)
    return (
        cam[2] > near
        and cam[2] <= LIMIT
        and wp.abs(cam[0]) <= LIMIT
        and wp.abs(cam[1]) <= LIMIT
        and norm >= SMALLEST_QUAT
        and norm <= LARGEST_QUAT
        and scale[0] <= LIMIT
        and scale[1] <= LIMIT
        and scale[2] <= LIMIT
        and wp.abs(u) <= LIMIT
        and wp.abs(v) <= LIMIT
        and trace <= MAX_VARIANCE
        and det >= MIN_DETERMINANT
    )


@wp.func
def onto_screen_adjoint(
    s: Screen, quat: wp.vec4, scale: wp.vec3, mean: wp.vec3, K: F32, world_to_camera: F32,
    v_u: float, v_v: float, v_depth: float, v_m0: wp.vec3, v_m1: wp.vec3,
) -> Raw:  # fmt: skip
    """Gradients of the raw geometry, given those of the centre, the depth and the rows m0, m1."""
    fx = K[0]
    fy = K[4]
    rotation = pose_rotation(world_to_camera)
    z = s.cam[2]
    inverse_z = 1.0 / z
    gain_x = fx * inverse_z
    gain_y = fy * inverse_z
    a2 = wp.vec3(s.cam_axes[2, 0], s.cam_axes[2, 1], s.cam_axes[2, 2])

    # m0 = gain_x (a0 - slope_x a2), m1 = gain_y (a1 - slope_y a2)
    v_a0 = gain_x * v_m0
    v_a1 = gain_y * v_m1
    v_a2 = -(s.slope_x * v_a0 + s.slope_y * v_a1)
    v_x = fx * v_u - s.free_x * wp.dot(a2, v_a0)  # by x / z and y / z
    v_y = fy * v_v - s.free_y * wp.dot(a2, v_a1)
    v_inverse_z = (wp.dot(s.m0, v_m0) + wp.dot(s.m1, v_m1)) * z + v_x * s.cam[0] + v_y * s.cam[1]
    v_cam = wp.vec3(
        v_x * inverse_z, v_y * inverse_z, v_depth - v_inverse_z * (inverse_z * inverse_z)
    )
    v_cam_axes = wp.mat33(
        v_a0[0], v_a0[1], v_a0[2], v_a1[0], v_a1[1], v_a1[2], v_a2[0], v_a2[1], v_a2[2]
    )
    v_axes = wp.transpose(rotation) * v_cam_axes

    raw = Raw()
    raw.mean = wp.transpose(rotation) * v_cam
    raw.translation = v_cam
    raw.rotation = wp.outer(v_cam, mean) + v_cam_axes * wp.transpose(s.axes)
    raw.log_scale = wp.vec3(
        v_axes[0, 0] * s.axes[0, 0] + v_axes[1, 0] * s.axes[1, 0] + v_axes[2, 0] * s.axes[2, 0],
        v_axes[0, 1] * s.axes[0, 1] + v_axes[1, 1] * s.axes[1, 1] + v_axes[2, 1] * s.axes[2, 1],
        v_axes[0, 2] * s.axes[0, 2] + v_axes[1, 2] * s.axes[1, 2] + v_axes[2, 2] * s.axes[2, 2],
    )
    v_turn = wp.mat33(
        v_axes[0, 0] * scale[0], v_axes[0, 1] * scale[1], v_axes[0, 2] * scale[2],
        v_axes[1, 0] * scale[0], v_axes[1, 1] * scale[1], v_axes[1, 2] * scale[2],
        v_axes[2, 0] * scale[0], v_axes[2, 1] * scale[1], v_axes[2, 2] * scale[2],
    )  # fmt: skip
    raw.quat = quat_adjoint(quat, v_turn)
    return raw


@wp.func
def shape_adjoint(
    s: Screen, quat: wp.vec4, scale: wp.vec3, mean: wp.vec3, K: F32, world_to_camera: F32,
    low_pass: float, v_u: float, v_v: float, v_depth: float, v_det: float, v_square: float,
    v_xy: float, v_yy: float, v_pose: F32, has_pose: int, row: int,
) -> Raw:  # fmt: skip
    """Gradients of the raw geometry, given those of the centre, the depth and the covariance.

    Args:
        v_det: by det. v_square: by its part |m0 x m1|^2, all together.
        v_xy, v_yy: by the covariance, other than through det.
        v_pose, has_pose, row: where more gradients of the pose go; a pinhole has none.
    """
    v_normal = 2.0 * v_square * s.normal
    v_m0 = wp.cross(s.m1, v_normal) + 2.0 * low_pass * v_det * s.m0 + v_xy * s.m1
    v_m1 = wp.cross(v_normal, s.m0) + 2.0 * (low_pass * v_det + v_yy) * s.m1 + v_xy * s.m0
    return onto_screen_adjoint(
        s, quat, scale, mean, K, world_to_camera, v_u, v_v, v_depth, v_m0, v_m1
    )
