"""Points of what stands still: of a moving camera, or on a floor, a wall and measured depth."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import Delaunay, QhullError
from torch import Tensor

from hoigs.core.values.camera import Camera, pinhole_rays
from hoigs.preparation.completion import completed
from hoigs.preparation.depth import median_depth
from hoigs.preparation.final_masks import EntityMasks
from hoigs.preparation.mask_stack import Images
from hoigs.preparation.video.pictures import shrink, shrink_mask
from hoigs.preparation.video.source import SourceError

REFERENCE_WIDTH = 640  # the plate is made at this width, or the frames' if they are smaller
PLATE_FRAMES = 48  # a median over more frames changes nothing visible
MASK_MARGIN = 4  # pixels at 640: soft edges, motion blur and shadows at the feet


@dataclass(frozen=True)
class Plate:
    """The background without what moves.

    Attributes:
        image: RGB, 0..255; what is never seen is made from patches of the rest.
        seen: pixels that some frame shows.
    """

    image: UInt8[np.ndarray, "H W 3"]
    seen: Bool[np.ndarray, "H W"]


def background_plate(
    frames: Iterable[tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]], margin: int
) -> Plate:
    """Median colour over time of each pixel outside the masks, which are grown by `margin`.

    Args:
        frames: images with masks of everything that moves; a few dozen suffice.
    """
    images, hidden = [], []
    for image, mask in frames:
        images.append(image)
        hidden.append(ndimage.binary_dilation(mask, iterations=margin) if margin else mask)
    stack, covered = np.stack(images), np.stack(hidden)
    stack = np.sort(np.where(covered[..., None], np.uint8(255), stack), axis=0)
    visible = (~covered).sum(0)
    # the visible values are sorted to the front: covered ones became 255
    middle = np.maximum(visible - 1, 0) // 2
    median = np.take_along_axis(stack, middle[None, ..., None].astype(np.int64), axis=0)[0]
    seen = visible > 0
    return Plate(completed(median, seen), seen)


def supposed_depth(
    camera: Camera, ground: float, backdrop: float, pixels: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch"]:
    """Depth of a level floor below a level camera, ended by a wall.

    Args:
        camera: level, so that its y axis points down. ground: height of the camera over the floor,
            metres. backdrop: depth of the wall, metres.
        pixels: x, y.

    Returns:
        metres along z: ground / tan(angle below the horizon), at most `backdrop`.
    """
    below = pinhole_rays(camera.K, pixels)[..., 1]
    floor = ground / below.clamp_min(ground / backdrop)
    return floor.clamp_max(backdrop)


def plate_points(
    plate: Plate,
    camera: Camera,
    *,
    ground: float,
    backdrop: float,
    count: int,
    within: Bool[np.ndarray, "H W"] | None = None,
    measured: Float[np.ndarray, "H W"] | None = None,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Points on floor and wall, denser where the plate has detail, with its colours.

    Args:
        camera: of the plate's size. count: of points, about.
        within: pixels of the plate that some frame shows, and that get points; None: all.
        measured: depth of the plate, metres, 0 where floor and wall are supposed; None: everywhere.

    Returns:
        points in the world, metres, and RGB in [0, 1].
    """
    cells = quadtree(plate.image, count)
    if within is not None:
        cells = [(y, x, h, w) for y, x, h, w in cells if within[y + h // 2, x + w // 2]]
    means = [plate.image[y : y + h, x : x + w].mean((0, 1)) for y, x, h, w in cells]
    colors = torch.tensor(np.array(means), dtype=torch.float32) / 255
    middles = [(x + w / 2, y + h / 2) for y, x, h, w in cells]
    pixels = torch.tensor(middles, dtype=torch.float32)
    depth = supposed_depth(camera, ground, backdrop, pixels)
    if measured is not None:
        column, row = pixels.long().unbind(-1)
        known = torch.from_numpy(measured)[row, column]
        depth = torch.where(known > 0, known, depth)
    return camera.unproject(pixels, depth), colors


def quadtree(
    image: UInt8[np.ndarray, "H W 3"], count: int, largest: int = 16
) -> list[tuple[int, int, int, int]]:
    """About `count` cells (y, x, height, width) that tile an image with least squared error.

    The cell whose pixels differ most from their mean is split in four, again and again. Of a
    garden at 640x360, 20,000 cells keep more (24.5 dB) than a regular grid of 37,000 (24.0 dB).
    """
    sums = np.pad(image.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0), (0, 0)))
    energy = (image.astype(np.int64) ** 2).sum(-1)
    squares = np.pad(energy.cumsum(0).cumsum(1), ((1, 0), (1, 0)))

    def cell(y: int, x: int, h: int, w: int) -> tuple[float, int, int, int, int]:
        total = sums[y + h, x + w] - sums[y, x + w] - sums[y + h, x] + sums[y, x]
        square = squares[y + h, x + w] - squares[y, x + w] - squares[y + h, x] + squares[y, x]
        return (-float(square - (total**2).sum() / (h * w)), y, x, h, w)

    height, width = image.shape[:2]
    heap = [
        cell(y, x, min(largest, height - y), min(largest, width - x))
        for y in range(0, height, largest)
        for x in range(0, width, largest)
    ]
    heapq.heapify(heap)
    whole: list[
        tuple[float, int, int, int, int]
    ] = []  # single rows, columns and pixels, which are not split
    while heap and len(heap) + len(whole) < count:
        _, y, x, h, w = heapq.heappop(heap)
        if h < 2 or w < 2:
            whole.append((0.0, y, x, h, w))
            continue
        for top, tall in ((y, h // 2), (y + h // 2, h - h // 2)):
            for left, wide in ((x, w // 2), (x + w // 2, w - w // 2)):
                heapq.heappush(heap, cell(top, left, tall, wide))
    return [(y, x, h, w) for _, y, x, h, w in (*heap, *whole)]


# PlateView: the one picture that all frames of a camera in one place are carried into.

WIDEST = 70  # degrees off the middle that one plane can show
LARGEST = 2000  # pixels of the plate's longer side
Shown = tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]


@dataclass(frozen=True)
class PlateView:
    """A camera without a turn that sees what all frames see.

    Attributes:
        camera: at most `REFERENCE_WIDTH` wide if all frames look the same way, else as fine and as
            wide as it takes.
        still: all frames look the same way.
        margin: pixels that masks are grown by.
    """

    camera: Camera
    still: bool
    margin: int

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> PlateView:
        """
        Raises:
            SourceError: the frames look into directions too far apart for one picture.
        """
        first = cameras[0]
        width = min(first.width, REFERENCE_WIDTH)
        small = first.resized(width, max(1, round(first.height * width / first.width)))
        margin = max(1, round(MASK_MARGIN * width / REFERENCE_WIDTH))
        poses = torch.stack([c.world_to_camera for c in cameras])
        if bool((poses == poses[0]).all()):
            return cls(small, True, margin)
        corners = torch.stack([_corners(c) for c in cameras]).reshape(-1, 3)
        off = float(torch.rad2deg(torch.acos(corners[:, 2].min())))
        if off > WIDEST:
            raise SourceError(
                f"the camera turns until it looks {off:.0f} degrees off the middle of its way, "
                f"and its background is made for {WIDEST} at most: choose a part (--start, --end)"
            )
        xy = corners[:, :2] / corners[:, 2:] * small.focal + small.K[:2, 2]
        low, high = xy.min(0).values.floor(), xy.max(0).values.ceil()
        wide = small.cropped(int(low[0]), int(low[1]), *(int(v) for v in high - low))
        wide = replace(wide, world_to_camera=torch.eye(4))
        shrunk = min(1.0, LARGEST / max(wide.width, wide.height))
        return cls(
            wide.resized(*(round(v * shrunk) for v in (wide.width, wide.height))), False, margin
        )

    def carried(
        self, image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"], camera: Camera
    ) -> Shown:
        """A frame and its mask as the plate's camera sees them; what it does not show is masked."""
        size = (self.camera.width, self.camera.height)
        if self.still:
            return shrink(image, *size), shrink_mask(moving, *size)
        width = round(camera.width * min(1.0, float(self.camera.K[0, 0] / camera.K[0, 0])))
        height = max(1, round(camera.height * width / camera.width))
        pixels, _ = self._pixels(camera.resized(width, height))
        tensor = torch.from_numpy(shrink(image, width, height)).permute(2, 0, 1)[None].float()
        moved = _sampled(tensor, pixels, "bilinear")[0].permute(1, 2, 0).round().byte().numpy()
        hidden = torch.from_numpy(shrink_mask(moving, width, height))[None, None].float()
        return moved, _sampled(1 - hidden, pixels, "nearest")[0, 0].numpy() < 0.5

    def carried_depth(
        self, metres: Float[np.ndarray, "H W"], moving: Bool[np.ndarray, "H W"], camera: Camera
    ) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
        """Depth along z, 0 unknown, likewise."""
        if self.still:
            return metres, moving
        pixels, depth = self._pixels(camera)
        values = torch.from_numpy(np.where(moving, 0, metres).astype(np.float32))[None, None]
        found = _sampled(values, pixels, "nearest")[0, 0] / depth.clamp_min(1e-3)
        return found.numpy(), (found <= 0).numpy()

    def within(self, cameras: Sequence[Camera]) -> Bool[np.ndarray, "h w"]:
        """Pixels of the plate that some frame's picture shows."""
        if self.still:
            return np.ones((self.camera.height, self.camera.width), bool)
        shown = torch.zeros(self.camera.height, self.camera.width, dtype=torch.bool)
        for camera in cameras:
            pixels, depth = self._pixels(camera)
            shown |= camera.shows(pixels, depth)
        return shown.numpy()

    def _pixels(self, camera: Camera) -> tuple[Float[Tensor, "h w 2"], Float[Tensor, "h w"]]:
        """Where a camera sees what the plate's pixels show, and its depth if that is 1 in the
        plate."""
        grid = self.camera.pixel_grid()
        return camera.project(self.camera.unproject(grid, torch.ones(grid.shape[:2])))


def _corners(camera: Camera) -> Float[Tensor, "4 3"]:
    """Directions of a frame's corners in the world."""
    w, h = float(camera.width), float(camera.height)
    corners = camera.unproject(torch.tensor([[0, 0], [w, 0], [0, h], [w, h]]), torch.ones(4))
    return torch.nn.functional.normalize(corners, dim=-1)


def _sampled(
    values: Float[Tensor, "1 C H W"], pixels: Float[Tensor, "h w 2"], mode: str
) -> Float[Tensor, "1 C h w"]:
    """Images repeat their rim outside; nearest values are 0 there."""
    size = pixels.new_tensor((values.shape[3], values.shape[2]))
    at = (2 * pixels / size - 1).clamp(-9, 9)
    return torch.nn.functional.grid_sample(
        values, at[None], mode=mode, align_corners=False,
        padding_mode="border" if mode == "bilinear" else "zeros",
    )  # fmt: skip


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
    wall: float,
    count: int,
    metres: Callable[[int], Float[np.ndarray, "H W"]] | None = None,
) -> ScenePoints:
    """A floor under the feet and a wall behind, coloured by the frames' unmasked pixels.

    Args:
        images: gives the frames anew. masks: of the frames.
        cameras: of the frames, all in the world's origin; they may look into other directions.
        ground: height of the camera over the floor, metres. wall: distance of the wall, metres.
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
        plate, view.camera, ground=ground, backdrop=wall, count=count,
        within=within, measured=measured,
    )  # fmt: skip
    floor = f"a level floor {ground:.2f} m below a level camera and a wall at {wall:.1f} m"
    if measured is None:
        text = f"supposed: {floor}, coloured by the median of unmasked pixels; its depth is not "
        text += "measured, and "
    else:
        share = 100 * float((measured[within] > 0).mean())
        text = f"the median of the depth maps over unmasked pixels, {share:.0f} % of the image "
        text += f"(else {floor}); "
    text += (
        f"{100 * (1 - plate.seen[within].mean()):.1f} % of it is never seen: patches of the rest "
    )
    text += "stand there"
    return ScenePoints(points, colors, text)
