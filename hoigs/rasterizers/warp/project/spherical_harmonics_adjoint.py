# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""The adjoint of spherical harmonics on CUDA.

A Gaussian has up to 48 coefficients. One thread that reads and writes them alone needs as many
memory transactions, so a warp moves those of its 32 Gaussians together, through shared memory.
With 111,785 Gaussians of degree 3 on an H200 this shortens the adjoint of projection and colour
from 150 to 58 microseconds.
"""

from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.project.kernels import camera_center
from hoigs.rasterizers.warp.project.spherical_harmonics import (
    Vec16,
    learns,
    sh_basis,
    sh_direction_gradient,
)
from hoigs.rasterizers.warp.records import F32, I32, RECORD, RED, VEC3

wp.set_module_options({"enable_backward": False, "max_unroll": 16})

BLOCK = 128
_ROW = 49  # numbers that a row of the buffer takes: odd, so that rows start in different banks
RECORD_C = wp.constant(RECORD)

# A warp's rows as they lie in memory, `width` numbers each. Where SPARSE of them or fewer have a
# gradient, those are moved one by one; else all numbers are walked: `i` in the array, and `at` in
# the buffer; `r` is the row's number in the warp.
_SPARSE = 8
_ROWS = r"""
    const int lane = threadIdx.x & 31, first = row - lane;
    const int rows = count - first < 32 ? count - first : 32;
    float* mine = (float*)buffer + (threadIdx.x - lane) * %(ROW)d;
    float* array = (float*)values.data + (long long)first * width;
    unsigned visible = __ballot_sync(0xffffffffu, wanted);
    if (__popc(visible) <= %(SPARSE)d) {
        %(BEFORE)s
        for (; visible != 0; visible &= visible - 1) {
            const int r = __ffs(visible) - 1;
            for (int column = lane; column < width; column += 32) {
                const int i = r * width + column, at = r * %(ROW)d + column;
                %(MOVE)s
            }
        }
    } else {
        int r = 0, column = lane;
        for (int i = lane; i < rows * width; i += 32, column += 32) {
            while (column >= width) {
                column -= width;
                ++r;
            }
            const int at = r * %(ROW)d + column;
            %(WALK)s
        }
    }
"""
_LOAD = {"BEFORE": "", "MOVE": "mine[at] = array[i];"}
_LOAD |= {"WALK": "if (visible >> r & 1) mine[at] = array[i];"}
# 32 rows begin at a multiple of 16 bytes, whatever the width
_STORE = {
    "BEFORE": r"""
        const float4 zero = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        for (int i = lane; i < rows * width / 4; i += 32) ((float4*)array)[i] = zero;
        for (int i = rows * width / 4 * 4 + lane; i < rows * width; i += 32) array[i] = 0.0f;
        __syncwarp();
""",
    "MOVE": "array[i] = mine[at];",
    "WALK": "array[i] = visible >> r & 1 ? mine[at] : 0.0f;",
}
_SIZES = {"ROW": _ROW, "SPARSE": _SPARSE}


@wp.func_native(f"__shared__ float rows[{BLOCK * _ROW}]; return (wp::uint64)rows;")
def row_buffer() -> wp.uint64: ...


@wp.func_native(_ROWS % (_SIZES | _LOAD) + "__syncwarp();")
def load_rows(values: F32, buffer: wp.uint64, row: int, count: int, width: int, wanted: bool): ...


@wp.func_native("__syncwarp();" + _ROWS % (_SIZES | _STORE))
def store_rows(values: F32, buffer: wp.uint64, row: int, count: int, width: int, wanted: bool): ...


@wp.func_native(f"return ((float*)buffer)[threadIdx.x * {_ROW} + index];")
def get(buffer: wp.uint64, index: int) -> float: ...


@wp.func_native(f"((float*)buffer)[threadIdx.x * {_ROW} + index] = value;")
def put(buffer: wp.uint64, index: int, value: float): ...


@wp.kernel(launch_bounds=BLOCK)
def harmonics_adjoint(
    means: VEC3,
    sh: F32,  # [N, stored_bases, 3]
    stored_bases: int,
    active_bases: int,  # more than 1
    world_to_camera: F32, records: F32,
    drawn: I32,  # 1 where a Gaussian has a gradient, else 0
    colors: VEC3,  # of the colour; becomes that of the camera centre through the viewing direction
    v_sh: F32,
    count: int,  # N; the launch is rounded up to whole blocks
):  # fmt: skip
    row = wp.tid()
    buffer = row_buffer()
    visible = False
    if row < count:
        visible = drawn[row] != 0
    load_rows(sh, buffer, row, count, 3 * stored_bases, visible)
    if visible:
        v_color = wp.vec3(0.0, 0.0, 0.0)
        given = colors[row]
        for j in range(3):
            if learns(records[row * RECORD_C + RED + j]):
                v_color[j] = given[j]
        toward = means[row] - camera_center(world_to_camera)
        distance = wp.length(toward)
        direction = toward / distance
        basis = sh_basis(direction, active_bases)
        dots = Vec16()
        for k in range(16):
            if k < active_bases:
                dots[k] = (
                    get(buffer, 3 * k) * v_color[0]
                    + get(buffer, 3 * k + 1) * v_color[1]
                    + get(buffer, 3 * k + 2) * v_color[2]
                )
        v_direction = sh_direction_gradient(direction, dots, active_bases)
        colors[row] = (wp.dot(direction, v_direction) * direction - v_direction) / distance
        for k in range(16):
            if k < stored_bases:
                for j in range(3):
                    put(buffer, 3 * k + j, basis[k] * v_color[j])
    store_rows(v_sh, buffer, row, count, 3 * stored_bases, visible)
