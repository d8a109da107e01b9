"""Scene points in metres: COLMAP's without the people, or a supposed floor and wall."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import Delaunay, QhullError
from torch import Tensor

from hoigs.core.values.camera import Camera
from hoigs.preparation.entities.final_masks import EntityMasks
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.scene.background_points import (
    PLATE_FRAMES,
    PlateView,
    background_plate,
    plate_points,
    quadtree,
)
from hoigs.preparation.scene.depth import median_depth
from hoigs.preparation.video.source import SourceError

# More scene points than COLMAP's few thousand: its depths, interpolated between its points.
#
# A run of thousands of steps has no time to grow a textured floor from sparse points; published
# methods take seven to thirty thousand steps for it. Between neighbouring points of one surface,
# inverse depth is linear in the image, so a triangle of three of them gives the depth of its
# pixels.

KEYFRAMES = 5
LARGEST_CELL = 8  # pixels: coarser cells would leave holes in plain surfaces
DEEPEST_RATIO = 1.5  # farthest over nearest corner: above it a triangle spans two surfaces
LONGEST_SIDE = 0.25  # of the image's diagonal
MARGIN = 4  # pixels around masks: soft edges and shadows


def keyframes(total: int) -> list[int]:
    """Frames to densify from, the middle one first, then outwards: evenly spread."""
    spread = np.linspace(0, total - 1, min(KEYFRAMES, total)).round().astype(int).tolist()
    return sorted(set(spread), key=lambda i: abs(i - total // 2))


def densify(
    points: Float[Tensor, "P 3"],
    frames: Sequence[tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"], Camera]],
    count: int,
) -> tuple[Float[Tensor, "D 3"], Float[Tensor, "D 3"]]:
    """Points on the surfaces that `points` span, where frames have detail, with their colours.

    Args:
        points: sparse, on static surfaces, in the cameras' world.
        frames: image, mask of what moves, camera; each adds what the frames before it missed.
        count: of points, about, over all frames.

    Returns:
        the new points (without the sparse ones) and RGB in [0, 1]; none where nothing is spanned.
    """
    found, colors = [points.new_zeros(0, 3)], [points.new_zeros(0, 3)]
    for number, (image, moving, camera) in enumerate(frames):
        left = count - sum(map(len, found))
        if left <= 0:
            break
        # the first frame sees most of the scene; later ones add borders and what it had hidden
        share = left if number == len(frames) - 1 else round(left * 0.7)
        hidden = ndimage.binary_dilation(moving, iterations=MARGIN)
        hidden |= _covered(torch.cat(found), camera)
        cells = quadtree(image, max(1, round(share / max(0.05, 1 - hidden.mean()))), LARGEST_CELL)
        boxes = np.array([c for c in cells if not hidden[c[0] + c[2] // 2, c[1] + c[3] // 2]])
        if len(boxes) == 0:
            continue
        middles = np.stack((boxes[:, 1] + boxes[:, 3] / 2, boxes[:, 0] + boxes[:, 2] / 2), 1)
        depth = interpolated_depth(points, hidden_by=moving, camera=camera, pixels=middles)
        known = np.isfinite(depth)
        means = [image[y : y + h, x : x + w].mean((0, 1)) for y, x, h, w in boxes[known]]
        pixels = torch.from_numpy(middles[known]).float()
        found.append(camera.unproject(pixels, torch.from_numpy(depth[known]).float()))
        colors.append(torch.from_numpy(np.array(means).reshape(-1, 3)).float() / 255)
    return torch.cat(found), torch.cat(colors)


def interpolated_depth(
    points: Float[Tensor, "P 3"],
    *,
    hidden_by: Bool[np.ndarray, "H W"],
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
) -> Float[np.ndarray, " N"]:
    """Depth at pixels, metres, inverse-linear within triangles of the points seen there.

    NaN outside all triangles, and in those that are too long or span a jump in depth.
    """
    xy, z = camera.project(points)
    inside = camera.shows(xy, z)
    corners, depths = xy[inside].double().numpy(), z[inside].double().numpy()
    column, row = np.floor(corners).astype(int).T
    shown = ~hidden_by[row, column]
    corners, depths = corners[shown], depths[shown]
    result = np.full(len(pixels), np.nan)
    if len(corners) < 4:
        return result
    try:
        mesh = Delaunay(corners)
    except QhullError:  # all on one line of the image: nothing lies between them
        return result
    triangle = mesh.find_simplex(pixels)
    rows = np.flatnonzero(triangle >= 0)
    used = mesh.simplices[triangle[rows]]
    at, deep = corners[used], depths[used]
    sides = np.linalg.norm(at - np.roll(at, 1, axis=1), axis=-1).max(1)
    good = sides < LONGEST_SIDE * np.hypot(camera.width, camera.height)
    good &= deep.max(1) < DEEPEST_RATIO * deep.min(1)
    rows, used, deep = rows[good], used[good], deep[good]
    affine = mesh.transform[triangle[rows]]
    first = np.einsum("nij,nj->ni", affine[:, :2], pixels[rows] - affine[:, 2])
    weights = np.concatenate((first, 1 - first.sum(1, keepdims=True)), 1)
    result[rows] = 1 / (weights / deep).sum(1)
    return result


def _covered(points: Float[Tensor, "P 3"], camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Pixels that earlier points lie on already, or next to."""
    covered = np.zeros((camera.height, camera.width), dtype=bool)
    if len(points) == 0:
        return covered
    xy, z = camera.project(points)
    inside = camera.shows(xy, z)
    column, row = xy[inside].long().unbind(1)
    covered[row.numpy(), column.numpy()] = True
    return ndimage.binary_closing(covered, iterations=3) | covered


@dataclass(frozen=True)
class ScenePoints:
    """Points in the world, metres, RGB in [0, 1], and what they were made from."""

    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    provenance: str


def camera_scene(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    masks: EntityMasks,
    cameras: Sequence[Camera],
    images: Images,
    count: int,
) -> ScenePoints:
    """The points that came with the cameras but for those on the person or the object, and more
    between them.

    A point goes if, of the frames that see its place, at least half see it inside a mask.

    Args:
        masks: of the frames. images: gives the frames anew.
        count: of points, about: the gaps are filled up to it (`dense_points.densify`).
    """
    inside = torch.zeros(len(points))
    visible = torch.zeros(len(points))
    for i, camera in enumerate(cameras):
        xy, depth = camera.project(points)
        seen = camera.shows(xy, depth)
        column, row = xy[seen].long().unbind(-1)
        moving = torch.from_numpy(masks.moving(i))
        visible += seen
        inside[seen] += moving[row, column]
    keep = inside < 0.5 * visible.clamp_min(1)
    if not keep.any():
        raise SourceError("every scene point lies on the person or the object")
    dropped = f"{int((~keep).sum())} of {len(points)} on the person or object dropped"
    text = f"points that came with the cameras, {dropped}"
    points, colors = points[keep], colors[keep]
    chosen = keyframes(len(cameras))
    shown = {i: image for i, image in enumerate(images()) if i in chosen}
    frames = [(shown[i], masks.moving(i), cameras[i]) for i in chosen]
    more, more_colors = densify(points, frames, max(0, count - len(points)))
    text += f"; {len(more)} more interpolated between them in {len(chosen)} frames"
    return ScenePoints(torch.cat((points, more)), torch.cat((colors, more_colors)), text)


def static_scene(
    images: Images,
    masks: EntityMasks,
    cameras: Sequence[Camera],
    *,
    ground: float,
    distance: float,
    backdrop: float,
    count: int,
    metres: Callable[[int], Float[np.ndarray, "H W"]] | None = None,
) -> ScenePoints:
    """A floor under the feet and a wall behind, coloured by the frames' unmasked pixels.

    Args:
        images: gives the frames anew. masks: of the frames.
        cameras: of the frames, all in the world's origin; they may look into other directions.
        ground: height of the camera over the floor, metres. distance: of the person, metres.
        backdrop: distance of the wall in distances of the person.
        count: of points, about.
        metres: measured depth of a frame, 0 where unknown; None: it is supposed everywhere.
    """
    chosen = set(np.linspace(0, len(cameras) - 1, PLATE_FRAMES).round().astype(int).tolist())
    view = PlateView.of(cameras)
    shown = (
        view.carried(image, masks.moving(i), cameras[i])
        for i, image in enumerate(images())
        if i in chosen
    )
    plate = background_plate(shown, view.margin)
    measured = None
    if metres is not None:
        depths = (
            view.carried_depth(metres(i), masks.moving(i), cameras[i]) for i in sorted(chosen)
        )
        measured = median_depth(depths, (view.camera.width, view.camera.height))
    within = view.within([cameras[i] for i in sorted(chosen)])
    points, colors = plate_points(
        plate, view.camera, ground=ground, backdrop=backdrop * distance, count=count,
        within=within, measured=measured,
    )  # fmt: skip
    floor = (
        f"a level floor {ground:.2f} m below a level camera and a wall at "
        f"{backdrop * distance:.1f} m"
    )
    if measured is None:
        text = f"supposed: {floor}, coloured by the median of unmasked pixels; its depth is not "
        text += "measured, and "
    else:
        share = 100 * float((measured[within] > 0).mean())
        text = f"the median of the depth maps over unmasked pixels, {share:.0f} % of the image "
        text += f"(else {floor}); "
    text += f"{100 * (1 - plate.seen[within].mean()):.1f} % of it is never seen"
    return ScenePoints(points, colors, text)
