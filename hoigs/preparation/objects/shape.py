"""Points that an object starts from: a sphere, or its outline inflated; colours from the frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.maths.frame_times import fill_gaps, smooth
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera, pinhole_rays
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.mask_stack import MaskStack, Outlines, outlines_of
from hoigs.preparation.objects.alignment import FACING, Crops, Poses, Surface
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.registered import registered
from hoigs.preparation.video.source import SourceError


def sphere_points(count: int, radius: float) -> Float[Tensor, "P 3"]:
    """Evenly spread points on a sphere (Fibonacci lattice), metres."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    turn = i * torch.pi * (3 - 5**0.5)
    ring = (1 - z * z).sqrt()
    return (radius * torch.stack((ring * turn.cos(), ring * turn.sin(), z), -1)).float()


class ColorSampler:
    """Median colours of moving points, over the frames in which they face the camera.

    A point counts in a frame if it faces the camera and lies on the object's mask. Points never
    seen take the colour of the nearest seen one.

    Args:
        points: canonical, about the object's centre. normals: unit, outwards.
    """

    def __init__(self, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> None:
        self.points, self.normals = points, normals
        self._samples: list[np.ndarray] = []

    def add(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        mask: Bool[np.ndarray, "H W"],
        camera: Camera,
        rotation: Float[Tensor, "3 3"],
        translation: Float[Tensor, " 3"],
    ) -> None:
        world = self.points @ rotation.mT + translation
        to_camera = torch.nn.functional.normalize(camera.center - world, dim=-1)
        facing = ((self.normals @ rotation.mT) * to_camera).sum(-1) > 0.3
        xy, depth = camera.project(world)
        seen = np.flatnonzero((camera.shows(xy, depth) & facing).numpy())
        column, row = xy[seen].long().numpy().T
        on_mask = mask[row, column]
        colors = np.full((len(world), 3), np.nan, np.float32)
        colors[seen[on_mask]] = image[row, column][on_mask] / np.float32(255)
        self._samples.append(colors)

    def colors(self) -> Float[Tensor, "P 3"]:
        """RGB in [0, 1]; mid-grey if no point was ever seen."""
        if not self._samples:
            return torch.full_like(self.points, 0.5)
        samples = np.stack(self._samples)
        seen = np.isfinite(samples[..., 0]).any(0)
        if not seen.any():
            return torch.full_like(self.points, 0.5)
        result = np.zeros(samples.shape[1:], np.float32)
        result[seen] = np.nanmedian(samples[:, seen], axis=0)
        known = torch.from_numpy(np.flatnonzero(seen))
        nearest = torch.cdist(self.points, self.points[known]).argmin(-1).numpy()
        result[~seen] = result[seen][nearest[~seen]]
        return torch.from_numpy(result)


def inflated_outline(
    mask: Bool[np.ndarray, "H W"], camera: Camera, depth: float, count: int
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """A front and a back sheet that meet at a mask's outline, and their outward normals.

    The half thickness at a pixel is sqrt(d (2 D - d)) / 2 for its distance d to the outline and
    the largest such distance D: a cushion, half as thick as it is wide. What the back looks like
    is not known.

    Args:
        depth: of the outline along z, metres.

    Returns:
        points in *camera* coordinates about their own mean direction, metres, and unit normals.
    """
    distance = ndimage.distance_transform_edt(mask)
    area = int(mask.sum())
    step = max(1, int(np.sqrt(area / max(1, count / 2))))
    rows, columns = np.nonzero(mask)
    keep = (rows % step == 0) & (columns % step == 0)
    rows, columns = rows[keep], columns[keep]
    scale = depth / float(camera.K[0, 0])
    inner = distance.max()
    relief = np.sqrt(np.clip(distance * (2 * inner - distance), 0, None)) / 2
    smooth_relief = ndimage.gaussian_filter(relief, 1.0)
    slope_y, slope_x = np.gradient(smooth_relief)
    half = relief[rows, columns] * scale
    pixels = torch.from_numpy(np.stack((columns + 0.5, rows + 0.5), -1))
    rays = pinhole_rays(camera.K.double(), pixels).numpy()
    sheets, normals = [], []
    for side in (-1.0, 1.0):
        z = depth + side * half
        sheets.append(np.concatenate((rays * z[:, None], z[:, None]), -1))
        tilt = np.stack((-slope_x[rows, columns], -slope_y[rows, columns]), -1)
        normals.append(np.concatenate((tilt, np.full((len(tilt), 1), side)), -1))
    points = torch.tensor(np.concatenate(sheets), dtype=torch.float32)
    outward = torch.tensor(np.concatenate(normals), dtype=torch.float32)
    return points, torch.nn.functional.normalize(outward, dim=-1)


# The mesh that an alignment starts from: the visual hull of the masks at rough poses.

DIVISIONS = 3  # of an icosahedron: 642 vertices
SHELLS = 40  # distances tried along each ray
CARVED = 0.1  # share of the frames that may show background at a point of the hull


def hull(
    crops: Crops, poses: Poses, radius: float, samples: int, carved: float = CARVED
) -> Surface:
    """A mesh whose vertices lie on rays from the object's middle, as far out as masks allow.

    A place belongs to the object unless more than `carved` of the frames show background there;
    pixels of the person do not count, as they may hide it. The mesh is star-shaped about the
    object's middle: holes and deep hollows are filled.

    Args:
        radius: metres within which the object lies. samples: points on the surface.
    """
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=DIVISIONS)
    directions, faces = (
        torch.from_numpy(np.array(mesh.vertices)).float(),
        torch.from_numpy(np.array(mesh.faces)).long(),
    )
    reach = reaches(crops, poses, directions, radius, carved)
    return with_samples(directions * reach[:, None], faces, samples)


def reaches(
    crops: Crops, poses: Poses, directions: Float[Tensor, "V 3"], radius: float, carved: float
) -> Float[Tensor, " V"]:
    """Metres from the object's middle along unit rays to the hull."""
    steps = torch.linspace(0.05, 1.0, SHELLS) * radius
    places = directions[:, None] * steps[:, None]  # V, S, 3
    flat = places.flatten(0, 1)
    background = torch.zeros(len(flat))
    known = torch.zeros(len(flat))
    maps = torch.cat((crops.masks, crops.hidden), 1)
    for i in range(len(crops)):
        one = crops.rows(np.array([i]))
        xy, _ = one.project((flat @ poses.rotations[i].mT + poses.translations[i])[None])
        mask, hidden = one.sample(maps[i : i + 1], xy)[0].T
        inside = ((xy[0] >= 0) & (xy[0] < crops.size)).all(-1)
        mask = torch.where(inside, mask, 0.0)
        seen = 1 - torch.where(inside, hidden, 0.0)
        background += seen * (1 - mask).clamp(0, 1)
        known += seen
    empty = (background / known.clamp_min(1)).reshape(len(directions), SHELLS)
    # the share grows outwards; where it passes the limit is found between two shells
    empty = torch.cummax(empty, 1).values
    index = (empty < carved).sum(1).clamp(1, SHELLS - 1)
    rows = torch.arange(len(directions))
    low, high = empty[rows, index - 1], empty[rows, index]
    part = ((carved - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)
    return steps[index - 1] + part * (steps[index] - steps[index - 1])


def with_samples(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "T 3"], count: int) -> Surface:
    """A mesh with points spread over it, by area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1).numpy().astype(np.float64)
    rng = np.random.default_rng(0)
    # one of each equal share of the area: more even than independent draws
    cut = (np.arange(count) + rng.random(count)) / count * area.sum()
    chosen = np.searchsorted(np.cumsum(area), cut).clip(0, len(area) - 1)
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    weights = torch.from_numpy(np.stack((1 - u - v, u, v), -1)).float()
    pairs = torch.cat([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    edges = torch.unique(pairs.sort(1).values, dim=0)
    return Surface(vertices, faces, faces[torch.from_numpy(chosen)], weights, edges)


# The side of an object that no frame shows: like the opposite side, within the outlines.

ONE_SIDED = 0.9  # mean of the unit directions to the cameras: from there on they see one side
SEEN = 0.2  # of the frames in which a vertex faces the camera: what they show stays as it is
DEPTH = 0.85  # of the root of its outlines' area: midway between what a search tries
WHOLE = 0.75  # quantile of the areas: hands hide a part of it in some frames
FRONT = 0.9  # quantile of what is seen, along the view: the outermost may be a bulge
OPPOSITE = 0.15  # radians within which a seen vertex lies opposite an unseen one
DIRECTIONS = 64  # across the view, in which the middle is measured
CARVED_UNSEEN = 0.02  # of the frames may show background at the new surface; poses are good by now


def completed(
    crops: Crops, surface: Surface, poses: Poses, vertices: Float[Tensor, "V 3"], radius: float
) -> tuple[Float[Tensor, "V 3"], float | None]:
    """Vertices with the unseen side filled, and the depth that it was filled to, metres; as they
    are, and None, where the frames show more than one side.

    The alignment leaves what no frame shows as small and smooth as outlines allow: a dome behind
    the front, which also hangs down behind a thing seen from above. Most things are about as deep
    as they are broad and high, and about the same on opposite sides: each unseen vertex goes along
    its ray from the middle as far as the seen vertex opposite, or where there is none as a slab of
    that depth across the mean view, but no farther than the masks of (nearly) all frames allow.

    Args:
        radius: metres within which the object lies.
    """
    middle = (vertices.amax(0) + vertices.amin(0)) / 2
    toward = (crops.centers() - poses.translations - poses.rotations @ middle)[:, None]
    toward = (toward @ poses.rotations)[:, 0]
    away, toward = toward.norm(dim=-1), torch.nn.functional.normalize(toward, dim=-1)
    view = toward.mean(0)
    if view.norm() < ONE_SIDED:
        return vertices, None
    view = torch.nn.functional.normalize(view, dim=0)
    areas = crops.masks.sum((1, 2, 3)) * (away / crops.K[:, 0, 0]).square()
    depth = DEPTH * float(areas.quantile(WHOLE)) ** 0.5
    facing = surface.vertex_normals(vertices) @ toward.mT > FACING
    seen = facing.float().mean(1) >= SEEN
    front = float((vertices[seen] @ view).quantile(FRONT))
    middle = _across(vertices, view) + view * (front - depth / 2)
    placed = Poses(poses.rotations, poses.translations + poses.rotations @ middle)
    rays = torch.nn.functional.normalize(vertices - middle, dim=-1)
    slab = depth / 2 / (rays @ view).abs().clamp_min(1e-6)
    cosine, nearest = (-rays @ rays[seen].mT).max(1)
    opposite = (vertices[seen] - middle).norm(dim=-1)[nearest]
    wanted = torch.where(cosine > math.cos(OPPOSITE), opposite, slab)
    reach = torch.minimum(reaches(crops, placed, rays, radius, CARVED_UNSEEN), wanted)
    return torch.where(seen[:, None], vertices, middle + rays * reach[:, None]), depth


def _across(vertices: Float[Tensor, "V 3"], view: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The middle across the view, nearest to the middles of the extents in many directions: that
    of a thing that is alike on opposite sides shows in its outline."""
    angles = torch.arange(DIRECTIONS) * torch.pi / DIRECTIONS
    plane = torch.linalg.svd(view[None]).Vh[1:]  # two directions across the view
    directions = torch.stack((angles.cos(), angles.sin()), -1) @ plane
    along = vertices @ directions.mT
    middles = (along.amax(0) + along.amin(0)) / 2
    return torch.linalg.lstsq(directions @ plane.mT, middles[:, None]).solution[:, 0] @ plane


# An object keeps its size but shows other sides; a wrist fitted to one view is off by as much as
# an arm may point towards the camera. The hands give the level, the size most of the change.
SIZE_WEIGHT = 0.75
SMOOTHING = 15  # frames
LAID = 0.5  # overlap of the template and a mask from which it lies as the object does


def held_object(filmed: Filmed, count: int) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float]:
    """A held object: what one frame shows of it laid over the others, at the hands' depth, its
    outline inflated to a shape.

    Of its rotation only the roll in the image is observable this way; the turning about other
    axes is left to training.

    Args:
        count: of points, about.

    Returns:
        the track (grey: colours are sampled afterwards), the points' outward normals, and the
        spread of the object's apparent over its expected size.
    """
    masks, cameras = filmed.masks, filmed.cameras
    outlines = outlines_of(masks)
    if filmed.joints is not None:
        by = "the nearest wrist"
        depths = hand_depths(masks, cameras, filmed.joints[:, [LEFT_WRIST, RIGHT_WRIST]])
    else:
        assert filmed.depths is not None  # one of both is given
        by, depths = "a supposed size", filmed.depths
    found = registered(filmed, outlines)
    known = found.overlaps >= LAID
    depths = _depths(np.where(known, found.sizes, np.nan), depths)
    centers = fill_gaps(found.centers, known)
    translations = torch.stack([
        c.unproject(torch.from_numpy(p).float(), torch.tensor(float(d)))
        for c, p, d in zip(cameras, centers, depths, strict=True)
    ])  # fmt: skip
    best = found.template
    rest, normals = inflated_outline(masks[best], cameras[best], float(depths[best]), count)
    to_world = cameras[best].world_to_camera[:3, :3].mT
    rest = (rest - cameras[best].to_camera(translations[best])) @ to_world.mT
    rotations = _rolls(np.where(known, found.angles, np.nan), cameras, best)
    size, spread = apparent_size(rest, rotations, translations, masks, outlines, cameras)
    track = ObjectTrack(
        points=rest * size,
        colors=torch.full_like(rest, 0.5),
        rotations=rotations,
        translations=translations,
        observed=torch.from_numpy(outlines.observed),
        provenance=(
            f"frame {best} laid over the others ({int(known.sum())} of them fit, the overlap is "
            f"{np.nanmedian(found.overlaps):.2f}); depth from {by} and its image size; of its "
            f"rotation only the roll; shape from the outline of frame {best}, half as "
            "thick as wide: a weak guess"
        ),
        rotation_known=False,
    )
    return track, normals @ to_world.mT, spread


def hand_depths(
    masks: MaskStack, cameras: Sequence[Camera], wrists: Float[Tensor, "F 2 3"]
) -> Float[np.ndarray, " F"]:
    """Depth of the wrist that is nearest to the object in the image, metres.

    Args:
        wrists: left and right, world, metres.
    """
    depths, known = np.zeros(len(masks)), np.zeros(len(masks), dtype=bool)
    for i, (mask, camera) in enumerate(zip(masks, cameras, strict=True)):
        xy, depth = camera.project(wrists[i])
        known[i] = bool(mask.any()) and bool((depth > 0).any())
        if known[i]:
            away = _distance_to(mask, xy.numpy())
            away[depth.numpy() <= 0] = np.inf
            depths[i] = float(depth[int(away.argmin())])
    if not known.any():
        raise SourceError("no frame shows the object and a hand in front of the camera")
    return fill_gaps(depths, known)


def _distance_to(
    mask: Bool[np.ndarray, "H W"], xy: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, " N"]:
    """Pixels from each position, which may lie outside the image, to the mask's nearest pixel."""
    rows, columns = np.nonzero(mask & ~ndimage.binary_erosion(mask))
    edge = np.stack((columns, rows), -1) + 0.5
    return np.linalg.norm(xy[:, None] - edge[None], axis=-1).min(1).astype(np.float64)


def _depths(
    sizes: Float[np.ndarray, " F"], hands: Float[np.ndarray, " F"]
) -> Float[np.ndarray, " F"]:
    """Depths of hands, corrected so that its sizes in the image agree; metres, smoothed."""
    known = np.isfinite(sizes)
    # log of depth by size over depth by hands, up to a constant: the size in metres
    log_ratio = fill_gaps(-np.log(sizes * hands), known)
    log_ratio -= np.median(log_ratio[known])
    return np.exp(smooth(np.log(hands) + SIZE_WEIGHT * log_ratio, SMOOTHING))


def _rolls(
    angles: Float[np.ndarray, " F"], cameras: Sequence[Camera], template: int
) -> Float[Tensor, "F 3 3"]:
    """Rotations about the viewing axis by which what a camera sees of the object is turned in the
    image against what the template's camera sees."""
    known = np.isfinite(angles)
    views = torch.stack([c.world_to_camera[:3, :3] for c in cameras]).double()
    between = views @ views[template].mT  # a camera that turns about its axis turns the image, too
    twist = torch.atan2(between[:, 1, 0] - between[:, 0, 1], between[:, 0, 0] + between[:, 1, 1])
    rolls = angles - twist.numpy()
    rolls[known] = np.unwrap(rolls[known])
    rolls = smooth(fill_gaps(rolls, known))
    return axis_angle_to_matrices((views[:, 2] * torch.from_numpy(rolls)[:, None]).float())


def apparent_size(
    points: Float[Tensor, "P 3"],
    rotations: Float[Tensor, "F 3 3"],
    translations: Float[Tensor, "F 3"],
    masks: MaskStack,
    outlines: Outlines,
    cameras: Sequence[Camera],
) -> tuple[float, float]:
    """S = median of sqrt(A_mask / A_projected) over frames, and its relative spread.

    Box areas in pixels (HOIGS, object initialisation; the paper takes the mean). Frames in which
    the mask is cut by the image's border or smaller than half the median do not count.
    """
    enough = 0.5 * np.median(outlines.areas[outlines.observed])
    ratios = []
    for i in np.flatnonzero(outlines.whole & (outlines.areas >= enough)).tolist():
        xy, depth = cameras[i].project(points @ rotations[i].mT + translations[i])
        if (depth <= 0).any():
            continue
        projected = np.prod((xy.max(0).values - xy.min(0).values).numpy())
        rows, columns = np.nonzero(masks[i])
        ratios.append(np.sqrt((np.ptp(rows) + 1) * (np.ptp(columns) + 1) / projected))
    if not ratios:
        return 1.0, 0.0
    return float(np.median(ratios)), float(np.std(ratios) / np.median(ratios))
