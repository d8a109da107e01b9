# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Layout of the arrays between kernels, and the types of their parameters.

One *record* of RECORD floats (64 bytes, one cache line) describes a drawn Gaussian on screen.
With d = (dx, dy) from its centre, u = dx - shear dy, and the screen covariance xx, xy, yy:

    log2 alpha = log2_opacity - a u^2 - c dy^2       two squares: nothing cancels in thin splats
    a = log2(e) / 2 * yy / det,  c = log2(e) / 2 / yy,  shear = xy / yy

A *partial* is the gradient of one Gaussian from one tile, MOMENTS + F floats, and ABSOLUTES more
where absolute gradients are requested. There is one for each tile intersection, and those of a
Gaussian are neighbours in memory. Each is written by one tile and they are summed in a fixed order,
so that no atomics are needed and results do not depend on the schedule. (On CUDA there is one
exception, where intersections exceed the allocated memory: see `warp.cuda.intersections`.)
"""

import math

from hoigs.core.system.quiet_warp import wp

F32 = wp.array(dtype=wp.float32)
I32 = wp.array(dtype=wp.int32)
I64 = wp.array(dtype=wp.int64)
U8 = wp.array(dtype=wp.uint8)
U64 = wp.array(dtype=wp.uint64)
VEC3 = wp.array(dtype=wp.vec3)
VEC4 = wp.array(dtype=wp.vec4)

RECORD = 16
X = wp.constant(0)  # centre, pixels
Y = wp.constant(1)
A = wp.constant(2)
SHEAR = wp.constant(3)
C = wp.constant(4)
LOG2_OPACITY = wp.constant(5)
RED = wp.constant(6)  # then green, blue; -0 where clamped so that no gradient passes
BLUE = wp.constant(8)
DEPTH = wp.constant(9)  # follows blue: four channels composited alike
HALF_WIDTH = wp.constant(10)  # of the box where alpha >= min_alpha; negative when culled
HALF_HEIGHT = wp.constant(11)
SLOPE = wp.constant(12)  # xy / xx: dy of the ellipse's middle per dx
WAIST_Y = wp.constant(13)  # half height of the ellipse at dx = 0
WAIST_X = wp.constant(14)  # half width at dy = 0
INVERSE_HALF_WIDTH = wp.constant(15)

# partials: sums over the pixels of one tile of g = dloss / d(ln alpha), then of colour and depth
MOMENTS = 10
M_G = wp.constant(0)
M_U = wp.constant(1)  # g u
M_Y = wp.constant(2)  # g dy
M_UU = wp.constant(3)
M_UY = wp.constant(4)
M_YY = wp.constant(5)
M_RED = wp.constant(6)  # then green, blue, depth

# last in a partial: sums of |dloss / du|, |dloss / dv| of the projected mean, where requested
ABSOLUTES = 2

POSE = 15  # gradient of the pose from one Gaussian: R (9), t (3), camera centre (3)

HALF_LOG2E = wp.constant(0.5 / math.log(2.0))
# Ellipses are widened by this when their pixels are sought. Each pixel's alpha is then tested
# exactly, so this only guards against rounding.
REACH_SLACK = wp.constant(1.001)
# min_alpha = 0 means no cut-off; in float32 nothing below this is visible.
SMALLEST_ALPHA = 1e-12
