# mypy: ignore-errors
# Warp's arrays annotate as values, and wp.float64(0.0) declares a variable that a loop may change.
"""The projection kernels of cameras with optics: one Gaussian by the unscented transform, and its
adjoint.

The rules and names are those at the head of `hoigs.core.maths.optics`. In place of K the kernels
take an array that `frame.camera_numbers` makes:

    0 to 8 K | 9 model | 10 to 21 k1 to k6, p1, p2, s1 to s4 | 22 largest s | 23 whether it moves
    24 to 26 a, b, c of a pixel's time | 27 to 32 the motion w, d

Points are in float64 (`D`); what leaves these functions is float32. Of a point at rest,
Y = R x, and X = Exp(time w) Y + t + time d with time = tau - 1/2. Where tau depends on the place p
through p = P(X(tau)), tau = e.p + c, the implicit function theorem gives the adjoint: with
m = dP/dX dX/dtau, the gradient v of p is v + e (m.v) / (1 - m.e) at fixed tau. A change of X at
fixed tau changes tau by e.(dP/dX dX) / (1 - m.e), which tells where the iteration for the six other
points starts. The last step of an iteration is added to the place as m times the step.
"""

from hoigs.core.fast.launch import CPU_FLAGS
from hoigs.core.maths import optics as rules
from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.frame import MOTION
from hoigs.rasterizers.warp.project.geometry import Raw, fits, quat_adjoint
from hoigs.rasterizers.warp.project.kernels import make_kernels
from hoigs.rasterizers.warp.records import F32, POSE

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS, "max_unroll": 1})

D = wp.float64
Places = wp.types.matrix(shape=(7, 2), dtype=wp.float64)
Times = wp.types.vector(length=7, dtype=wp.float64)
MODEL = wp.constant(9)
RADIAL = wp.constant(10)
TANGENTIAL = wp.constant(16)
PRISM = wp.constant(18)
LARGEST_SLOPE = wp.constant(22)
MOVES = wp.constant(23)
ROW_TIME = wp.constant(24)
TURN = wp.constant(27)
ORTHO = wp.constant(rules.MODELS.index("ortho"))
FISHEYE = wp.constant(rules.MODELS.index("fisheye"))
STEP = wp.constant(wp.float64(rules.STEP))
BEND = wp.constant(wp.float64(rules.BEND))
SMALL_SLOPE = wp.constant(wp.float64(rules.SMALL_SLOPE))
ITERATIONS = wp.constant(rules.SHUTTER_ITERATIONS)
TOLERANCE = wp.constant(wp.float64(rules.SHUTTER_TOLERANCE))
POSE_C = wp.constant(POSE)
MOTION_C = wp.constant(MOTION)


@wp.struct
class Place:
    """A point on the image, and its derivatives by the point in camera coordinates."""

    p: wp.vec2d
    du: wp.vec3d
    dv: wp.vec3d
    valid: int


@wp.struct
class Seen:
    """A place at the time at which its row is exposed."""

    place: Place
    turned: wp.vec3d  # Exp(time w) Y
    z: wp.float64  # of X
    time: wp.float64
    m: wp.vec2d  # the place's change with time
    gain: wp.float64  # 1 / (1 - m.e), or 0 where the clamp holds the time


@wp.struct
class OpticsScreen:
    """As `geometry.Screen`, for the kernels."""

    cam: wp.vec3
    u: float
    v: float
    xx: float
    xy: float
    yy: float
    normal: wp.vec3  # its length is the area before the low-pass
    det: float
    nearest: float  # z of the nearest of the seven points; negative where one has no place
    places: Places  # of the mean, then those in the direction of each axis, then the opposite ones
    times: Times  # at which each is seen
    shift: wp.vec2d
    raw_xx: wp.float64  # without the low-pass
    raw_xy: wp.float64
    raw_yy: wp.float64


@wp.func
def number(K: F32, index: int) -> wp.float64:
    return wp.float64(K[index])


@wp.func
def place_of(point: wp.vec3d, K: F32) -> Place:
    found = Place()
    one = D(1.0)
    two = D(2.0)
    fx = number(K, 0)
    fy = number(K, 4)
    center = wp.vec2d(number(K, 2), number(K, 5))
    model = int(K[MODEL])
    if model == ORTHO:
        found.p = wp.vec2d(fx * point[0], fy * point[1]) + center
        found.du = wp.vec3d(fx, D(0.0), D(0.0))
        found.dv = wp.vec3d(D(0.0), fy, D(0.0))
        found.valid = 1
        return found
    inverse_z = D(1.0)
    if point[2] > D(0.0):
        inverse_z = one / point[2]
    x = point[0] * inverse_z
    y = point[1] * inverse_z
    s = x * x + y * y
    k1 = number(K, RADIAL)
    k2 = number(K, RADIAL + 1)
    k3 = number(K, RADIAL + 2)
    k4 = number(K, RADIAL + 3)
    gain = D(1.0)
    slope = D(0.0)  # of the gain, by s
    dx = D(0.0)
    dy = D(0.0)
    dx_x = D(0.0)
    dx_y = D(0.0)
    dy_x = D(0.0)
    dy_y = D(0.0)
    if model == FISHEYE:
        arc = D(1.0)
        arc_s = D(0.0)
        if s < SMALL_SLOPE:
            arc = one + s * (-one / D(3.0) + s * (D(0.2) + s * (-one / D(7.0) + s / D(9.0))))
            arc_s = -one / D(3.0) + s * (D(0.4) + s * (-D(3.0) / D(7.0) + s * D(4.0) / D(9.0)))
        else:
            root = wp.sqrt(s)
            arc = wp.atan(root) / root
            arc_s = (one / (one + s) - arc) / (two * s)
        w = arc * arc * s
        bent = one + w * (k1 + w * (k2 + w * (k3 + w * k4)))
        bent_w = k1 + w * (two * k2 + w * (D(3.0) * k3 + w * D(4.0) * k4))
        gain = arc * bent
        slope = arc_s * bent + arc * bent_w * (two * arc * arc_s * s + arc * arc)
    else:
        k5 = number(K, RADIAL + 4)
        k6 = number(K, RADIAL + 5)
        p1 = number(K, TANGENTIAL)
        p2 = number(K, TANGENTIAL + 1)
        s1 = number(K, PRISM)
        s2 = number(K, PRISM + 1)
        s3 = number(K, PRISM + 2)
        s4 = number(K, PRISM + 3)
        above = one + s * (k1 + s * (k2 + s * k3))
        below = one + s * (k4 + s * (k5 + s * k6))
        above_s = k1 + s * (two * k2 + s * D(3.0) * k3)
        below_s = k4 + s * (two * k5 + s * D(3.0) * k6)
        gain = above / below
        slope = (above_s - gain * below_s) / below
        dx = two * p1 * x * y + p2 * (s + two * x * x) + s * (s1 + s2 * s)
        dy = p1 * (s + two * y * y) + two * p2 * x * y + s * (s3 + s4 * s)
        across = two * (p1 * x + p2 * y)
        first = two * (s1 + two * s2 * s)
        second = two * (s3 + two * s4 * s)
        dx_x = two * p1 * y + D(6.0) * p2 * x + first * x
        dx_y = across + first * y
        dy_x = across + second * x
        dy_y = D(6.0) * p1 * y + two * p2 * x + second * y
    found.p = wp.vec2d(fx * (gain * x + dx), fy * (gain * y + dy)) + center
    mixed = two * x * y * slope
    a_x = fx * inverse_z * (gain + two * x * x * slope + dx_x)
    a_y = fx * inverse_z * (mixed + dx_y)
    b_x = fy * inverse_z * (mixed + dy_x)
    b_y = fy * inverse_z * (gain + two * y * y * slope + dy_y)
    found.du = wp.vec3d(a_x, a_y, -(a_x * x + a_y * y))
    found.dv = wp.vec3d(b_x, b_y, -(b_x * x + b_y * y))
    found.valid = 0
    if s <= number(K, LARGEST_SLOPE):
        found.valid = 1
    return found


@wp.func
def sine_share(angle: wp.float64) -> wp.float64:
    """sin(a) / a"""
    if angle < D(1.0e-4):
        return D(1.0) - angle * angle / D(6.0)
    return wp.sin(angle) / angle


@wp.func
def turned_by(vector: wp.vec3d, point: wp.vec3d) -> wp.vec3d:
    """Exp(vector) point."""
    angle = wp.length(vector)
    half = sine_share(D(0.5) * angle)
    once = wp.cross(vector, point)
    return point + sine_share(angle) * once + D(0.5) * half * half * wp.cross(vector, once)


@wp.func
def turn_adjoint(vector: wp.vec3d, v: wp.vec3d) -> wp.vec3d:
    """Transposed left Jacobian of the exponential map at `vector`, times v."""
    angle = wp.length(vector)
    half = sine_share(D(0.5) * angle)
    second = D(1.0) / D(6.0) - angle * angle / D(120.0)
    if angle > D(1.0e-2):
        second = (D(1.0) - sine_share(angle)) / (angle * angle)
    once = wp.cross(vector, v)
    return v - D(0.5) * half * half * once + second * wp.cross(vector, once)


@wp.func
def motion_turn(K: F32) -> wp.vec3d:
    return wp.vec3d(number(K, TURN), number(K, TURN + 1), number(K, TURN + 2))


@wp.func
def motion_shift(K: F32) -> wp.vec3d:
    return wp.vec3d(number(K, TURN + 3), number(K, TURN + 4), number(K, TURN + 5))


@wp.func
def row_time(K: F32) -> wp.vec2d:
    """e"""
    return wp.vec2d(number(K, ROW_TIME), number(K, ROW_TIME + 1))


@wp.func
def seen_at(rest: wp.vec3d, translation: wp.vec3d, start: wp.float64, K: F32) -> Seen:
    """The place of a point Y; a rolling shutter's iteration begins at the time `start`."""
    seen = Seen()
    seen.turned = rest
    seen.time = start
    seen.gain = D(0.0)
    seen.z = rest[2] + translation[2]
    if K[MOVES] == 0.0:
        seen.place = place_of(rest + translation, K)
    else:
        turn = motion_turn(K)
        shift = motion_shift(K)
        e = row_time(K)
        within = TOLERANCE * (wp.abs(e[0]) + wp.abs(e[1]))
        step = D(1.0)
        for _ in range(ITERATIONS):
            seen.turned = turned_by(seen.time * turn, rest)
            point = seen.turned + translation + seen.time * shift
            velocity = wp.cross(turn, seen.turned) + shift
            seen.place = place_of(point, K)
            seen.m = wp.vec2d(wp.dot(seen.place.du, velocity), wp.dot(seen.place.dv, velocity))
            slope = D(1.0) - wp.dot(seen.m, e)
            seen.gain = D(1.0)
            if slope > D(0.0):
                seen.gain = D(1.0) / slope
            shown = wp.dot(e, seen.place.p) + number(K, ROW_TIME + 2) - D(0.5)
            wanted = seen.time + seen.gain * (shown - seen.time)
            ahead = wp.clamp(wanted, D(-0.5), D(0.5))
            if wanted != ahead:
                seen.gain = D(0.0)
            step = ahead - seen.time
            seen.time = ahead
            seen.place.p = seen.place.p + step * seen.m
            seen.z = point[2] + step * velocity[2]
            if wp.abs(step) < within:
                break
        if not (wp.abs(step) < within):
            seen.place.valid = 0
    return seen


@wp.func
def at_fixed_time(seen: Seen, v: wp.vec2d, K: F32) -> wp.vec3d:
    """Gradient of X at fixed tau, given that of the place."""
    v = v + (seen.gain * wp.dot(seen.m, v)) * row_time(K)
    return v[0] * seen.place.du + v[1] * seen.place.dv


@wp.func
def rotation_of(pose: F32) -> wp.mat33d:
    return wp.mat33d(
        number(pose, 0), number(pose, 1), number(pose, 2),
        number(pose, 4), number(pose, 5), number(pose, 6),
        number(pose, 8), number(pose, 9), number(pose, 10),
    )  # fmt: skip


@wp.func
def translation_of(pose: F32) -> wp.vec3d:
    return wp.vec3d(number(pose, 3), number(pose, 7), number(pose, 11))


@wp.func
def axes_of(quat: wp.vec4, scale: wp.vec3) -> wp.mat33d:
    """rotation(quat) diag(scale), world."""
    q = wp.vec4d(D(quat[0]), D(quat[1]), D(quat[2]), D(quat[3]))
    q = q / wp.length(q)
    one = D(1.0)
    two = D(2.0)
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    a = D(scale[0])
    b = D(scale[1])
    c = D(scale[2])
    return wp.mat33d(
        a * (one - two * (y * y + z * z)), b * two * (x * y - w * z), c * two * (x * z + w * y),
        a * two * (x * y + w * z), b * (one - two * (x * x + z * z)), c * two * (y * z - w * x),
        a * two * (x * z - w * y), b * two * (y * z + w * x), c * (one - two * (x * x + y * y)),
    )  # fmt: skip


@wp.func
def column(matrix: wp.mat33d, k: int) -> wp.vec3d:
    return wp.vec3d(matrix[0, k], matrix[1, k], matrix[2, k])


@wp.func
def offset_of(axes: wp.mat33d, i: int) -> wp.vec3d:
    """From the mean to the i-th of the seven points."""
    if i == 0:
        return wp.vec3d(D(0.0), D(0.0), D(0.0))
    if i > 3:
        return -STEP * column(axes, i - 4)
    return STEP * column(axes, i - 1)


@wp.func
def difference(places: Places, k: int, sign: wp.float64) -> wp.vec2d:
    """G_k for a sign of -1, S_k for 1."""
    x = (places[k + 1, 0] - places[0, 0]) + sign * (places[k + 4, 0] - places[0, 0])
    y = (places[k + 1, 1] - places[0, 1]) + sign * (places[k + 4, 1] - places[0, 1])
    return wp.vec2d(x, y) / (D(2.0) * STEP)


@wp.func
def onto_screen(
    mean: wp.vec3, quat: wp.vec4, scale: wp.vec3, offset: wp.vec2, K: F32, world_to_camera: F32,
    width: int, height: int, low_pass: float,
) -> OpticsScreen:  # fmt: skip
    s = OpticsScreen()
    rotation = rotation_of(world_to_camera)
    translation = translation_of(world_to_camera)
    rest = rotation * wp.vec3d(D(mean[0]), D(mean[1]), D(mean[2]))
    axes = rotation * axes_of(quat, scale)
    places = Places()
    nearest = rest[2] + translation[2]
    valid = wp.int32(1)
    times = Times()
    # six points start from the mean's time; a loop that carries it would not be vectorised
    middle = D(0.0)
    later = wp.vec3d(D(0.0), D(0.0), D(0.0))  # gradient of the mean's time by X
    if K[MOVES] != 0.0:
        center = seen_at(rest, translation, D(0.0), K)
        e = center.gain * row_time(K)
        later = e[0] * center.place.du + e[1] * center.place.dv
        middle = center.time
    for i in range(7):
        from_mean = offset_of(axes, i)
        start = wp.clamp(middle + wp.dot(later, from_mean), D(-0.5), D(0.5))
        seen = seen_at(rest + from_mean, translation, start, K)
        times[i] = seen.time
        places[i, 0] = seen.place.p[0]
        places[i, 1] = seen.place.p[1]
        nearest = wp.min(nearest, seen.z)
        valid = valid * seen.place.valid
    xx = D(0.0)
    xy = D(0.0)
    yy = D(0.0)
    shift = wp.vec2d(D(0.0), D(0.0))
    for k in range(3):
        first = difference(places, k, D(-1.0))
        second = difference(places, k, D(1.0))
        xx += first[0] * first[0] + second[0] * second[0]
        xy += first[0] * first[1] + second[0] * second[1]
        yy += first[1] * first[1] + second[1] * second[1]
        shift += second / STEP
    xx += BEND * shift[0] * shift[0]
    xy += BEND * shift[0] * shift[1]
    yy += BEND * shift[1] * shift[1]
    low = D(low_pass)
    square = wp.max(xx * yy - xy * xy, D(0.0))
    s.cam = wp.vec3(
        float(rest[0] + translation[0]),
        float(rest[1] + translation[1]),
        float(rest[2] + translation[2]),
    )
    s.u = float(places[0, 0] + shift[0]) + offset[0]
    s.v = float(places[0, 1] + shift[1]) + offset[1]
    s.xx = float(xx + low)
    s.xy = float(xy)
    s.yy = float(yy + low)
    s.normal = wp.vec3(float(wp.sqrt(square)), 0.0, 0.0)
    s.det = float(square + low * (xx + yy) + low * low)
    s.nearest = -1.0
    if valid != 0:
        s.nearest = float(nearest)
    s.places = places
    s.times = times
    s.shift = shift
    s.raw_xx = xx
    s.raw_xy = xy
    s.raw_yy = yy
    return s


@wp.func
def is_regular(s: OpticsScreen, quat: wp.vec4, scale: wp.vec3, near: float) -> bool:
    """As `geometry.is_regular`; the nearest of the seven points is in front, too."""
    return s.nearest > near and fits(s.cam, s.u, s.v, s.xx + s.yy, s.det, quat, scale, near)


@wp.func
def shape_adjoint(
    s: OpticsScreen, quat: wp.vec4, scale: wp.vec3, mean: wp.vec3, K: F32, world_to_camera: F32,
    low_pass: float, v_u: float, v_v: float, v_depth: float, v_det: float, v_square: float,
    v_xy: float, v_yy: float, v_pose: F32, has_pose: int, row: int,
) -> Raw:  # fmt: skip
    """As `geometry.shape_adjoint`; writes the gradient of the motion after the poses'."""
    rotation = rotation_of(world_to_camera)
    translation = translation_of(world_to_camera)
    world_mean = wp.vec3d(D(mean[0]), D(mean[1]), D(mean[2]))
    rest = rotation * world_mean
    world_axes = axes_of(quat, scale)
    axes = rotation * world_axes

    # det = xx yy - xy^2 + low_pass (xx + yy) + low_pass^2, all without the low-pass
    low = D(low_pass) * D(v_det)
    by_xx = D(v_square) * s.raw_yy + low
    by_xy = D(v_xy) - D(2.0) * D(v_square) * s.raw_xy
    by_yy = D(v_square) * s.raw_xx + low + D(v_yy)
    # the covariance is a sum of c c^T: the gradient of c is `bend` c
    bend = wp.mat22d(D(2.0) * by_xx, by_xy, by_xy, D(2.0) * by_yy)
    v_mean = wp.vec2d(D(v_u), D(v_v))
    v_shift = v_mean + BEND * (bend * s.shift)
    v_places = Places()
    v_places[0, 0] = v_mean[0]
    v_places[0, 1] = v_mean[1]
    for k in range(3):
        v_first = bend * difference(s.places, k, D(-1.0))
        v_second = bend * difference(s.places, k, D(1.0)) + v_shift / STEP
        for j in range(2):
            v_places[k + 1, j] = (v_second[j] + v_first[j]) / (D(2.0) * STEP)
            v_places[k + 4, j] = (v_second[j] - v_first[j]) / (D(2.0) * STEP)
            v_places[0, j] = v_places[0, j] - v_second[j] / STEP
    v_rest = wp.vec3d(D(0.0), D(0.0), D(v_depth))  # of the mean's; those of the others are added
    v_translation = wp.vec3d(D(0.0), D(0.0), D(v_depth))
    v_turn = wp.vec3d(D(0.0), D(0.0), D(0.0))
    v_drift = wp.vec3d(D(0.0), D(0.0), D(0.0))
    v_axes = wp.mat33d()
    turn = motion_turn(K)
    for i in range(7):
        seen = seen_at(rest + offset_of(axes, i), translation, s.times[i], K)
        v_point = at_fixed_time(seen, wp.vec2d(v_places[i, 0], v_places[i, 1]), K)
        v_translation += v_point
        v_drift += seen.time * v_point
        v_turn += seen.time * turn_adjoint(seen.time * turn, wp.cross(seen.turned, v_point))
        v_point = turned_by(-seen.time * turn, v_point)
        v_rest += v_point
        if i > 0:
            k = (i - 1) % 3
            sign = wp.where(i > 3, -STEP, STEP)
            for j in range(3):
                v_axes[j, k] = v_axes[j, k] + sign * v_point[j]
    v_rotation = v_axes * wp.transpose(world_axes)
    v_world_axes = wp.transpose(rotation) * v_axes
    v_rotation += wp.outer(v_rest, world_mean)

    raw = Raw()
    raw.mean = single(wp.transpose(rotation) * v_rest)
    raw.translation = single(v_translation)
    turned = wp.mat33()
    log_scale = wp.vec3()
    for j in range(3):
        axis = column(world_axes, j)
        v_axis = column(v_world_axes, j)
        log_scale[j] = float(wp.dot(axis, v_axis))
        for k in range(3):
            turned[k, j] = float(v_axis[k]) * scale[j]
    raw.log_scale = log_scale
    raw.quat = quat_adjoint(quat, turned)
    raw.rotation = wp.mat33(
        float(v_rotation[0, 0]), float(v_rotation[0, 1]), float(v_rotation[0, 2]),
        float(v_rotation[1, 0]), float(v_rotation[1, 1]), float(v_rotation[1, 2]),
        float(v_rotation[2, 0]), float(v_rotation[2, 1]), float(v_rotation[2, 2]),
    )  # fmt: skip
    if has_pose != 0:
        at = has_pose * POSE_C + row * MOTION_C
        for k in range(3):
            v_pose[at + k] = float(v_turn[k])
            v_pose[at + 3 + k] = float(v_drift[k])
    return raw


@wp.func
def single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(v[0]), float(v[1]), float(v[2]))


project, project_adjoint = make_kernels(
    wp.get_module(__name__), onto_screen, is_regular, shape_adjoint
)
