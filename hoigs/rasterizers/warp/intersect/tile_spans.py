# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Which tiles a splat touches, as Warp functions. All tiles are TILE_WIDTH pixels wide."""

from hoigs.core.system.quiet_warp import wp
from hoigs.rasterizers.warp.records import F32, HALF_HEIGHT, HALF_WIDTH, SHEAR, SLOPE, WAIST_X, X, Y

TILE_WIDTH = 16
TILE_WIDTH_C = wp.constant(TILE_WIDTH)


@wp.func
def tile_row(y: float, tile_height: int, tiles_y: int) -> int:
    """The row of tiles in which y lies, or the nearest one."""
    return int(wp.clamp(wp.floor(y / float(tile_height)), 0.0, float(tiles_y - 1)))


@wp.func
def tile_row_range(records: F32, r: int, tile_height: int, tiles_y: int) -> wp.vec2i:
    """First and last row of tiles under a splat's box; r is where its record begins."""
    y = records[r + Y]
    half = records[r + HALF_HEIGHT]
    return wp.vec2i(
        tile_row(y - half, tile_height, tiles_y), tile_row(y + half, tile_height, tiles_y)
    )


@wp.func
def span(records: F32, r: int, ty: int, tile_height: int, tiles_x: int, width: int) -> wp.vec2i:
    """First and last tile of tile row ty whose pixel centres a splat's ellipse may touch."""
    x = records[r + X]
    half = records[r + HALF_HEIGHT]
    above = float(ty * tile_height) + 0.5 - records[r + Y]
    y0 = wp.max(above, -half)
    y1 = wp.min(above + float(tile_height - 1), half)
    if y0 > y1:
        return wp.vec2i(1, 0)
    # x(y) = shear y +- waist sqrt(1 - (y / half)^2); extreme where y = +-slope half_width
    shear = records[r + SHEAR]
    waist = records[r + WAIST_X]
    far = records[r + SLOPE] * records[r + HALF_WIDTH]
    inverse = 1.0 / wp.max(half, 1.0e-6)
    yr = wp.clamp(far, y0, y1)
    yl = wp.clamp(-far, y0, y1)
    sr = yr * inverse
    sl = yl * inverse
    right = x + shear * yr + waist * wp.sqrt(wp.max(0.0, 1.0 - sr * sr))
    left = x + shear * yl - waist * wp.sqrt(wp.max(0.0, 1.0 - sl * sl))
    if right < 0.5 or left > float(width) - 0.5:
        return wp.vec2i(1, 0)
    size = float(TILE_WIDTH_C)
    first = int(wp.floor(wp.max(0.0, left - 0.5) / size))
    last = int(wp.floor(wp.min(float(width) - 0.5, right - 0.5) / size))
    return wp.vec2i(first, wp.min(last, tiles_x - 1))
