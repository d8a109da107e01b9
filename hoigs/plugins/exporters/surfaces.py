"""Surfaces for programs of meshes: closed, with normals, texture coordinates and a texture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from scipy import ndimage
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.values.between import camera_between, frame_of
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.plugins.exporters.posed import SEEN, BodyMotion, ObjectMotion, eyes_of

CELLS = 48  # of a grid along the longest side of an object
VIEWS = 16  # cameras of the video that tell what of an object is empty
FEWEST = 8  # points of a surface
ALONE = 4.0  # a point this much farther from others than usual is no part of a surface
CELL_PX = 8  # least side of the square of two triangles, where a mesh has no texture coordinates
NEIGHBOURS = 12  # points that a vertex of an object follows


@dataclass(frozen=True)
class Surface:
    """A triangle mesh with a texture, metres, in the frame of what carries it.

    Attributes:
        vertices: [V, 3]. faces: [T, 3], outward. normals: unit, [V, 3].
        uv: of each corner of each face, v up, [T, 3, 2]. texture: RGB of a display, first row on
            top, [S, S, 3].
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    texture: np.ndarray

    def split(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As programs with one index a corner have it: rows of vertices [W], faces of these rows,
        and their texture coordinates [W, 2]."""
        corners = np.column_stack((self.faces.reshape(-1), self.uv.reshape(-1, 2)))
        kept, index = np.unique(corners, axis=0, return_inverse=True)
        return kept[:, 0].astype(int), index.reshape(-1, 3), kept[:, 1:]

    def vertex_colors(self) -> np.ndarray:
        """RGB in [0, 1] of the texture at each vertex, [V, 3]."""
        side = len(self.texture)
        corner = np.zeros((len(self.vertices), 2))
        corner[self.faces.reshape(-1)] = self.uv.reshape(-1, 2)
        column, row = np.clip((corner * (side, -side) + (0, side)).astype(int), 0, side - 1).T
        return self.texture[row, column] / 255.0

    def png(self) -> bytes:
        """The texture as a file."""
        out = BytesIO()
        Image.fromarray(self.texture).save(out, "png", optimize=False)
        return out.getvalue()


def body_surface(motion: BodyMotion, gaussians: Gaussians, side: int) -> Surface:
    """A person's mesh in the zero pose, whose texture has the colours of the Gaussians there."""
    vertices = motion.body.shaped(motion.betas)[0].double().numpy()
    faces, body = motion.body.faces.numpy(), motion.body
    uv, corners = getattr(body, "uv", None), getattr(body, "face_uv", None)
    own = None if uv is None or corners is None else uv.numpy()[corners.numpy()]
    return _painted(vertices, faces, own, gaussians, side)


@dataclass(frozen=True)
class View:
    """A camera of the video that has seen an object: from the object's frame to pixels.

    Attributes:
        matrix: [3, 4], object to camera. K: [3, 3]. size: width and height.
    """

    matrix: np.ndarray
    K: np.ndarray
    size: tuple[int, int]

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points [..., 3] are on the picture, [..., 2], and their depths, metres."""
        seen = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        depth = np.maximum(seen[..., 2], 1e-6)
        return (seen @ self.K.T)[..., :2] / depth[..., None], seen[..., 2]


def object_views(request: ExportRequest, motion: ObjectMotion) -> list[View]:
    """Some cameras of the video in the frame of an object."""
    found = []
    for i in np.unique(np.linspace(0, len(request.moments) - 1, VIEWS).round().astype(int)):
        camera = camera_between(request.clip, frame_of(request.clip, request.moments[i])).to("cpu")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = motion.rotations[i].numpy(), motion.translations[i].numpy()
        whole = (camera.world_to_camera.double().numpy() @ pose)[:3]
        found.append(View(whole, camera.K.double().numpy(), (camera.width, camera.height)))
    return found


def motion_surface(
    request: ExportRequest, motion: ObjectMotion, side: int
) -> tuple[Surface | None, dict[str, str]]:
    """The surface of an object in its frame, if it has one, and what it is not."""
    g = request.scene(request.moments[0], [motion.name]).gaussians[motion.name]
    g = g.detach().to("cpu", torch.float32)
    g = g[g.opacities > SEEN]
    turn, place = motion.rotations[0], motion.translations[0]
    sh = (mean_colors(g.sh, g.means, eyes_of(request.clip)) - 0.5) / SH_C0
    own = g.replace(means=(g.means - place) @ turn, sh=sh[:, None])
    found = object_surface(own, object_views(request, motion), side)
    name = f"surface of {motion.name}"
    if found is None:
        return None, {name: "its Gaussians enclose no volume: they are points"}
    surface, error = found
    return surface, {
        name: f"it is {1000 * error:.1f} mm (RMS) from the centres of the Gaussians, and closed "
        "where no camera saw it"
    }


def object_surface(
    gaussians: Gaussians, views: Sequence[View], side: int
) -> tuple[Surface, float] | None:
    """The closed surface through the Gaussians of an object, and the root mean square distance of
    their centres from it, metres; None where there is none.

    Sides that no camera saw are closed by the convex hull of the others.

    Args:
        gaussians: visible ones, in the object's frame.
    """
    points = gaussians.means.double().numpy()
    if len(points) < FEWEST:
        return None
    apart = cKDTree(points).query(points, 4)[0][:, 1:].mean(1)
    usual = apart < ALONE * np.median(apart)
    points, spacing = points[usual], float(apart[usual].mean())
    field, low, step = _signed_distances(points, spacing, views)
    if not (field < 0).any():  # so few points that cameras see through between them
        field, low, step = _signed_distances(points, spacing, ())
    vertices, faces = isosurface(field)
    if not len(faces):
        return None
    mesh = trimesh.Trimesh(low + step * vertices, faces, process=False)
    if not mesh.is_watertight:
        return None
    # where there are points, the surface goes through them
    far, near = cKDTree(points).query(mesh.vertices, min(NEIGHBOURS, len(points)))
    normals, reach = mesh.vertex_normals, far[:, :1] + 0.5 * spacing
    weights = np.exp(-0.5 * (far / reach) ** 2) * (far < 3 * spacing)
    middle = (points[near] * weights[..., None]).sum(1) / weights.sum(1, keepdims=True).clip(1e-9)
    step_out = ((middle - mesh.vertices) * normals).sum(1, keepdims=True) * normals
    mesh.vertices = mesh.vertices + np.where(far[:, :1] < 3 * spacing, step_out, 0)
    near = cKDTree(mesh.triangles_center).query(points, min(8, len(mesh.faces)))[1]
    asked = np.repeat(points, near.shape[1], 0)
    on = trimesh.triangles.closest_point(mesh.triangles[near.reshape(-1)], asked)
    away = np.linalg.norm(on - asked, axis=1).reshape(near.shape).min(1)
    made = _painted(np.array(mesh.vertices), np.array(mesh.faces), None, gaussians, side)
    return made, float(np.sqrt((away**2).mean()))


def _signed_distances(
    points: np.ndarray, spacing: float, views: Sequence[View]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Distances to points on a grid, negative in what they enclose, its corner, and its step.

    Enclosed is what is in their convex hull and no camera saw through (space carving, Kutulakos
    and Seitz 2000): before the nearest points of a pixel, and where a pixel has none.
    """
    step = max(float(np.ptp(points, axis=0).max()) / CELLS, 0.5 * spacing)
    low = points.min(0) - 3 * step
    count = np.ceil((points.max(0) + 3 * step - low) / step).astype(int) + 1
    nodes = low + step * np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1)
    nodes = nodes.reshape(-1, 3)
    distance = cKDTree(points).query(nodes)[0]
    try:
        corners = points[ConvexHull(points).vertices]
        inside = Delaunay(corners).find_simplex(nodes) >= 0
    except QhullError:  # all in one plane
        inside = np.zeros(len(nodes), bool)
    for view in views:
        (at, depth), (asked, ahead) = view.pixels(points), view.pixels(nodes)
        if depth.min() <= 0:
            continue
        pixel = 2 * spacing * view.K[0, 0] / np.median(depth)  # as wide as the gaps of points
        first = np.minimum(at.min(0), 0)
        wide, high = (np.maximum(at.max(0), view.size) - first) // pixel + 1
        nearest = np.full((int(high), int(wide)), np.inf)
        column, row = ((at - first) // pixel).astype(int).T
        np.minimum.at(nearest, (row, column), depth)
        # the next pixels too: silhouettes are those of surfaces, not of their points
        nearest = ndimage.minimum_filter(nearest, 3)
        seen = (ahead > 0) & ((asked >= 0) & (asked < view.size)).all(1)
        column, row = ((asked[seen] - first) // pixel).astype(int).T
        through = ahead[seen] < nearest[row, column] - spacing
        inside[np.flatnonzero(seen)[through]] = False
    signed = np.where(inside, -distance - 0.1 * step, distance + 0.1 * step)
    return ndimage.gaussian_filter(signed.reshape(count), 0.7), low, step


def isosurface(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The surface around the largest connected negative part of a grid, without its hollows, in
    steps of it: a vertex in each cell that it crosses (surface nets, Gibson 1998), triangles
    outward."""
    inner = _one_solid(field < 0)
    field = np.where(inner, np.minimum(field, -1e-3), np.maximum(field, 1e-3))
    sides = [slice(None, -1), slice(1, None)]
    corners = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    cut = [tuple(sides[k] for k in corner) for corner in corners]
    some = np.sum([inner[c] for c in cut], 0)
    cells = np.argwhere((some > 0) & (some < 8))
    index = np.full(some.shape, -1)
    index[tuple(cells.T)] = np.arange(len(cells))
    total, number = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a in range(8):
        for b in (a | 1, a | 2, a | 4):
            if a == b:
                continue
            one, two = (field[tuple((cells + corners[k]).T)] for k in (a, b))
            crossed = (one < 0) != (two < 0)
            share = np.where(crossed, one / np.where(crossed, one - two, 1), 0)[:, None]
            place = np.array(corners[a]) * (1 - share) + np.array(corners[b]) * share
            total, number = total + place * crossed[:, None], number + crossed
    faces = []
    for axis in range(3):
        low, high = np.moveaxis(inner, axis, 0)[:-1], np.moveaxis(inner, axis, 0)[1:]
        at = np.argwhere((low != high)[:, 1:-1, 1:-1]) + np.array((0, 1, 1))
        around = [np.moveaxis(index, axis, 0)[at[:, 0], at[:, 1] - i, at[:, 2] - j]
                  for i, j in ((1, 1), (0, 1), (0, 0), (1, 0))]  # fmt: skip
        quads = np.stack(around, 1)
        # axes turn right-handed for 0 and 2, left-handed for 1
        flipped = low[tuple(at.T)] == (axis == 1)
        quads[flipped] = quads[flipped][:, ::-1]
        faces += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return cells + total / number[:, None], np.concatenate(faces)


def _one_solid(inner: np.ndarray) -> np.ndarray:
    """The largest part of a set of nodes, filled, and thickened where it touches itself along an
    edge, as four faces would meet there."""
    while True:
        labels, _ = ndimage.label(inner, ndimage.generate_binary_structure(3, 2))
        sizes = np.bincount(labels.reshape(-1))[1:]
        if len(sizes) == 0:
            return inner
        inner = ndimage.binary_fill_holes(labels == 1 + sizes.argmax())
        thick = inner.copy()
        for first, second in ((0, 1), (0, 2), (1, 2)):
            seen, made = (np.moveaxis(x, (first, second), (0, 1)) for x in (inner, thick))
            halves = (slice(0, -1), slice(1, None))
            corners = [(i, j) for i in halves for j in halves]
            a, b, c, d = (seen[corner] for corner in corners)
            crossed = (a & d & ~b & ~c) | (b & c & ~a & ~d)
            for corner in corners:
                made[corner] |= crossed
        if (thick == inner).all():
            return inner
        inner = thick


def _painted(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None, gaussians: Gaussians, side: int
) -> Surface:
    """A mesh with normals and the baked colours of Gaussians near it.

    Args:
        uv: of each corner; without, triangles lie two by two in a grid of squares.
    """
    if uv is None:
        grid = int(np.ceil(np.sqrt((len(faces) + 1) // 2)))
        side = max(min(side, 3 * CELL_PX * grid), CELL_PX * grid)
        uv = _two_by_two(len(faces), grid, side)
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    texels, places = _samples(vertices[faces], uv, side)
    g = gaussians
    own, sizes = g.colors.clamp(0, 1).numpy(), g.scales.mean(-1).numpy()
    far, found = cKDTree(g.means.numpy()).query(places, min(8, len(g)))
    far, found = far.reshape(len(places), -1), found.reshape(len(places), -1)
    reach = np.maximum(sizes[found], far[:, 1:2])  # two always count
    weights = g.opacities.numpy()[found] * np.exp(-0.5 * (far / np.maximum(reach, 1e-9)) ** 2)
    colors = (own[found] * weights[..., None]).sum(1) / weights.sum(1, keepdims=True).clip(1e-9)
    image = np.zeros((side * side, 3), np.uint8)
    image[texels] = np.round(255 * colors)
    known = np.zeros(side * side, bool)
    known[texels] = True
    rows, columns = ndimage.distance_transform_edt(
        ~known.reshape(side, side), return_distances=False, return_indices=True
    )
    texture = image.reshape(side, side, 3)[rows, columns]
    return Surface(vertices, faces, np.array(normals), uv, texture)


def _two_by_two(count: int, grid: int, side: int) -> np.ndarray:
    """Texture coordinates of triangles in the halves of squares, a texel apart."""
    number = np.arange(count)
    cell = side / grid
    first = np.array(((1, 1), (cell - 3, 1), (1, cell - 3)))
    corners = np.where((number % 2 == 0)[:, None, None], first, cell - first)
    square = np.stack((number // 2 % grid, number // 2 // grid), -1)
    return (square[:, None] * cell + corners) / side


def _samples(corners: np.ndarray, uv: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels that faces cover, and the point of the surface at each."""
    edges = np.abs(uv - np.roll(uv, 1, 1)).max((1, 2)) * side
    steps = 2 ** np.ceil(np.log2(1.5 * edges.clip(1))).astype(int)
    found: dict[str, list[Any]] = {"texels": [], "places": []}
    for count in np.unique(steps):
        some = steps == count
        i, j = (x.reshape(-1) for x in np.mgrid[0 : count + 1, 0 : count + 1])
        i, j = i[i + j <= count], j[i + j <= count]
        shares = np.stack((count - i - j, i, j), -1) / count
        at = np.einsum("sc,tcd->tsd", shares, uv[some]).reshape(-1, 2)
        column, row = np.clip((at * (side, -side) + (0, side)).astype(int), 0, side - 1).T
        texels, first = np.unique(row * side + column, return_index=True)
        places = np.einsum("sc,tcd->tsd", shares, corners[some]).reshape(-1, 3)
        found["texels"].append(texels)
        found["places"].append(places[first])
    return np.concatenate(found["texels"]), np.concatenate(found["places"])
