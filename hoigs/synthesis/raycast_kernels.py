# mypy: ignore-errors
"""Warp kernels of the ray caster: nearest hit, texture and mesh colours, Lambert shading.

Directions have unit length along the camera's z, so a hit's parameter *is* the depth. A sample
uses one of the DIRECTIONS of the sun's disc and of the sky. Every pixel takes the same ones in
the same order, so that soft shadows have no noise; a pixel whose first samples disagree goes
on to see them all.
"""

from __future__ import annotations

# No `from __future__ import annotations` here: Warp reads kernel annotations as objects.
# float(1.0) declares a variable that a loop may change; a bare literal would be a constant.
# ruff: noqa: UP018, RUF046
from hoigs.core.system.quiet_warp import wp

wp.set_module_options({"enable_backward": False})
FINE = 4  # micro-triangles along an edge of a face with mesh colours
FINE_COUNT = (FINE + 1) * (FINE + 2) // 2
DIRECTIONS = 8  # over the sun's disc and over the sky
FAR = 100.0
MIRROR = 2  # entity that may be a mirror
REACH = 0.55  # of ambient occlusion, metres


@wp.struct
class Surface:
    mesh: wp.uint64
    normals: wp.array(dtype=wp.vec3)  # a corner
    uv: wp.array(dtype=wp.vec2)  # a corner
    texture: wp.array(dtype=wp.int32)  # a face; -1: mesh colours
    entity: wp.array(dtype=wp.int32)  # a face
    fine: wp.array(dtype=wp.vec3)  # FINE_COUNT a face of the first faces


@wp.struct
class Lights:
    sun: wp.vec3
    sky: wp.vec3
    ground: wp.vec3
    shadows: wp.float32
    occlusion: wp.float32
    mirror: wp.float32
    room_low: wp.vec3
    room_high: wp.vec3
    suns: wp.array(dtype=wp.vec3)
    skies: wp.array(dtype=wp.vec3)


@wp.struct
class View:
    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32
    width: wp.int32
    eye: wp.vec3
    to_world: wp.mat33


@wp.struct
class Hit:
    t: wp.float32
    layer: wp.int32  # 0 shell, 1 things; -1 none
    face: wp.int32
    u: wp.float32
    v: wp.float32


@wp.struct
class Shade:
    value: wp.vec3
    dark: wp.float32  # 1: the sun is hidden
    hidden: wp.float32  # 1: the sky is hidden


@wp.func
def nearest(shell: Surface, things: Surface, origin: wp.vec3, ray: wp.vec3):
    best = Hit()
    best.t = FAR
    best.layer = -1
    best.face = -1
    q = wp.mesh_query_ray(things.mesh, origin, ray, best.t)
    if q.result:
        best.t = q.t
        best.layer = 1
        best.face = q.face
        best.u = q.u
        best.v = q.v
        return best  # things stand inside the shell
    q = wp.mesh_query_ray(shell.mesh, origin, ray, best.t)
    if q.result:
        best.t = q.t
        best.layer = 0
        best.face = q.face
        best.u = q.u
        best.v = q.v
    return best


@wp.func
def texel(texels: wp.array(dtype=wp.vec3), start: int, width: int, height: int, x: int, y: int):
    column = wp.clamp(x, 0, width - 1)
    row = wp.clamp(y, 0, height - 1)
    return texels[start + row * width + column]


@wp.func
def bilinear(texels: wp.array(dtype=wp.vec3), level: wp.vec3i, u: float, v: float):
    width = level[1]
    height = level[2]
    x = u * float(width) - 0.5
    y = v * float(height) - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    a = x - float(x0)
    b = y - float(y0)
    top = texel(texels, level[0], width, height, x0, y0) * (1.0 - a)
    top += texel(texels, level[0], width, height, x0 + 1, y0) * a
    low = texel(texels, level[0], width, height, x0, y0 + 1) * (1.0 - a)
    low += texel(texels, level[0], width, height, x0 + 1, y0 + 1) * a
    return top * (1.0 - b) + low * b


@wp.func
def fine_index(i: int, j: int):
    # rows of a triangle of side FINE: row i (towards corner 0) holds FINE - i + 1 entries
    return i * (FINE + 1) - (i * (i - 1)) // 2 + j


@wp.func
def fine_color(fine: wp.array(dtype=wp.vec3), face: int, u: float, v: float):
    """Mesh colours (Yuksel, Keyser, House 2010): linear in the micro-triangle that holds (u, v)."""
    x = wp.clamp(u, 0.0, 1.0) * float(FINE)
    y = wp.clamp(v, 0.0, 1.0 - wp.clamp(u, 0.0, 1.0)) * float(FINE)
    i = wp.min(int(x), FINE - 1)
    j = wp.min(int(y), FINE - 1 - i)
    a = x - float(i)
    b = y - float(j)
    base = face * FINE_COUNT
    if a + b <= 1.0 or i + j >= FINE - 1:
        c0 = fine[base + fine_index(i, j)]
        c1 = fine[base + fine_index(i + 1, j)]
        c2 = fine[base + fine_index(i, j + 1)]
        return c0 * (1.0 - a - b) + c1 * a + c2 * b
    d0 = fine[base + fine_index(i + 1, j + 1)]
    d1 = fine[base + fine_index(i, j + 1)]
    d2 = fine[base + fine_index(i + 1, j)]
    return d0 * (a + b - 1.0) + d1 * (1.0 - a) + d2 * (1.0 - b)


@wp.func
def albedo(
    surface: Surface,
    texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i, ndim=2),
    hit: Hit,
    footprint: float,
):
    which = surface.texture[hit.face]
    if which < 0:
        return fine_color(surface.fine, hit.face, hit.u, hit.v)
    w = 1.0 - hit.u - hit.v
    corner = 3 * hit.face
    c0 = surface.uv[corner]
    c1 = surface.uv[corner + 1]
    c2 = surface.uv[corner + 2]
    uv = c0 * hit.u + c1 * hit.v + c2 * w
    mesh = wp.mesh_get(surface.mesh)
    p0 = mesh.points[mesh.indices[corner]]
    p1 = mesh.points[mesh.indices[corner + 1]]
    p2 = mesh.points[mesh.indices[corner + 2]]
    area = wp.length(wp.cross(p1 - p0, p2 - p0))
    e = c1 - c0
    f = c2 - c0
    uv_area = wp.abs(e[0] * f[1] - e[1] * f[0])
    base = levels[which, 0]
    # texels a metre, from the ratio of areas (the mapping is close to uniform)
    density = wp.sqrt(uv_area * float(base[1] * base[2]) / wp.max(area, 1.0e-12))
    wanted = wp.log2(wp.max(footprint * density, 1.0))
    lower = wp.min(int(wanted), levels.shape[1] - 1)
    upper = wp.min(lower + 1, levels.shape[1] - 1)
    mix = wp.clamp(wanted - float(lower), 0.0, 1.0)
    near = bilinear(texels, levels[which, lower], uv[0], uv[1])
    return near * (1.0 - mix) + bilinear(texels, levels[which, upper], uv[0], uv[1]) * mix


@wp.func
def blocked(things: wp.uint64, origin: wp.vec3, ray: wp.vec3, reach: float):
    if wp.mesh_query_ray_anyhit(things, origin, ray, reach):
        return 1.0
    return 0.0


@wp.func
def corner_dimming(lights: Lights, point: wp.vec3, normal: wp.vec3):
    """Sky that the room's own walls hide near an edge; smooth, known in closed form."""
    dim = float(1.0)
    for axis in range(3):
        away = 1.0 - wp.abs(normal[axis])
        dim *= 1.0 - 0.38 * away * wp.exp((lights.room_low[axis] - point[axis]) / 0.35)
        dim *= 1.0 - 0.38 * away * wp.exp((point[axis] - lights.room_high[axis]) / 0.35)
    return dim


@wp.func
def shade(
    surface: Surface, things: wp.uint64, texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i, ndim=2), lights: Lights, view: View, ray: wp.vec3, hit: Hit,
    sample: int,
):  # fmt: skip
    corner = 3 * hit.face
    smooth = surface.normals[corner] * hit.u + surface.normals[corner + 1] * hit.v
    smooth = wp.normalize(smooth + surface.normals[corner + 2] * (1.0 - hit.u - hit.v))
    flat = wp.mesh_eval_face_normal(surface.mesh, hit.face)
    slant = wp.dot(flat, ray)
    if slant > 0.0:  # the back of a face: light it as its front
        flat = -flat
        smooth = -smooth
    point = view.eye + ray * hit.t
    footprint = hit.t / view.fx / wp.sqrt(wp.max(wp.abs(slant) / wp.length(ray), 0.05))
    color = albedo(surface, texels, levels, hit, 0.75 * footprint)
    start = point + flat * 2.0e-3
    tangent = wp.normalize(wp.cross(smooth, wp.vec3(0.31, 0.17, 0.93)))
    bitangent = wp.cross(smooth, tangent)
    out = Shade()
    out.dark = 0.0
    out.hidden = 0.0
    towards = lights.suns[sample % DIRECTIONS]
    facing = wp.dot(smooth, towards)
    if facing > 0.0 and lights.shadows > 0.0:
        out.dark = blocked(things, start, towards, FAR)
    if lights.occlusion > 0.0:
        local = lights.skies[sample % DIRECTIONS]
        up = tangent * local[0] + bitangent * local[1] + smooth * local[2]
        out.hidden = blocked(things, start, up, REACH)
    sun = wp.max(facing, 0.0) * (1.0 - lights.shadows * out.dark)
    sky = lights.sky * (0.5 + 0.5 * smooth[1]) + lights.ground * (0.5 - 0.5 * smooth[1])
    open_share = 1.0 - lights.occlusion * out.hidden
    sky = sky * (open_share * corner_dimming(lights, point, smooth))
    out.value = wp.cw_mul(color, lights.sun * sun + sky)
    return out


@wp.func
def lit(
    shell: Surface, things: Surface, texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i, ndim=2), lights: Lights, view: View, ray: wp.vec3, hit: Hit,
    sample: int,
):  # fmt: skip
    """The light that a hit sends back by itself."""
    if hit.layer == 0:
        return shade(shell, things.mesh, texels, levels, lights, view, ray, hit, sample)
    if hit.layer == 1:
        return shade(things, things.mesh, texels, levels, lights, view, ray, hit, sample)
    return Shade()


@wp.func
def radiance(
    shell: Surface, things: Surface, texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i, ndim=2), lights: Lights, view: View, ray: wp.vec3, hit: Hit,
    sample: int,
):  # fmt: skip
    own = lit(shell, things, texels, levels, lights, view, ray, hit, sample)
    if lights.mirror > 0.0 and hit.layer == 1:  # noqa: SIM102  older Warps evaluate all of an `and`
        if things.entity[hit.face] == MIRROR:
            own.value *= 1.0 - lights.mirror
            own.value += lights.mirror * reflected(
                shell, things, texels, levels, lights, view, ray, hit, sample
            )
    return own


@wp.func
def reflected(
    shell: Surface, things: Surface, texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i, ndim=2), lights: Lights, view: View, ray: wp.vec3, hit: Hit,
    sample: int,
):  # fmt: skip
    """What a flat mirror at the hit shows: one more ray, whose own mirrors are dull."""
    flat = wp.mesh_eval_face_normal(things.mesh, hit.face)
    second = view  # its eye is the mirror; distances along the first ray count for texture detail
    towards = wp.normalize(ray - flat * (2.0 * wp.dot(flat, ray)))
    second.eye = view.eye + ray * hit.t + towards * 2.0e-3
    found = nearest(shell, things, second.eye, towards)
    seen = lit(shell, things, texels, levels, lights, second, towards, found, sample)
    return seen.value


@wp.func
def direction(view: View, x: float, y: float):
    return view.to_world * wp.vec3((x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0)


@wp.kernel
def render(
    shell: Surface, things: Surface, texels: wp.array(dtype=wp.vec3),
    levels: wp.array(dtype=wp.vec3i, ndim=2), lights: Lights, view: View,
    offsets: wp.array(dtype=wp.vec2), samples: int, edge_samples: int,
    color: wp.array(dtype=wp.vec3), depth: wp.array(dtype=wp.float32),
    entity: wp.array(dtype=wp.int32),
):  # fmt: skip
    pixel = wp.tid()
    column = float(pixel % view.width)
    row = float(pixel // view.width)
    centre = nearest(shell, things, view.eye, direction(view, column + 0.5, row + 0.5))
    depth[pixel] = 0.0
    entity[pixel] = -1
    if centre.layer >= 0:
        depth[pixel] = centre.t
    if centre.layer == 0:
        entity[pixel] = shell.entity[centre.face]
    if centre.layer == 1:
        entity[pixel] = things.entity[centre.face]

    total = wp.vec3(0.0, 0.0, 0.0)
    darkest = float(1.0e6)
    brightest = float(0.0)
    shadowed = float(0.0)
    hidden = float(0.0)
    varied = bool(False)
    count = int(0)
    wanted = int(samples)
    while count < wanted:
        ray = direction(view, column + offsets[count][0], row + offsets[count][1])
        hit = centre  # the first sample
        if count > 0:
            hit = nearest(shell, things, view.eye, ray)
        shaded = radiance(shell, things, texels, levels, lights, view, ray, hit, count)
        total += shaded.value
        count += 1
        if count <= samples:
            if hit.layer != centre.layer or wp.abs(hit.t - centre.t) > 0.03 * centre.t:
                varied = True
            luminance = shaded.value[0] + shaded.value[1] + shaded.value[2]
            darkest = wp.min(darkest, luminance)
            brightest = wp.max(brightest, luminance)
            shadowed += shaded.dark
            hidden += shaded.hidden
        if count == samples:
            # a sample sees one direction of sun and sky: if they disagree, take the others too
            if shadowed > 0.0 and shadowed < float(samples):
                varied = True
            if hidden > 0.0 and hidden < float(samples):
                varied = True
            if varied or brightest - darkest > 0.6 * (brightest + 0.2):
                wanted = edge_samples
    color[pixel] = total / float(count)
