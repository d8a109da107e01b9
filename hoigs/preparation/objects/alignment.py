"""Poses and shape of a rigid object from all frames at once: outlines, texture and hands.

The object is a closed mesh with points on its surface. A point's texture should be the same in all
frames that show it, no point may lie outside the mask, the mask's outline must be reached, the
motion is smooth in metres and radians per second, and what holds it keeps its place on it. There is
no model of the texture to be learnt: what is minimised is the variance of what the frames show at
each point, so that poses do not settle on a blurred picture of their own errors (direct bundle
adjustment, Delaunoy and Pollefeys 2014; Engel et al. 2018, without their camera model).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image
from scipy import ndimage
from scipy.spatial.distance import cdist
from torch import Tensor

from hoigs.core.maths.frame_times import fill_gaps
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.filmed import Filmed

MARGIN = 1.6  # side of a crop over the longer side of the mask's box
EDGES = 96  # pixels of the outline that a crop keeps
LIMB, NEAR = 0.08, 0.05  # metres: about a limb's bone, and in front of the camera
DARK = 0.05  # added before logarithms of brightness


@dataclass(frozen=True)
class Crops:
    """Square crops of one size.

    Attributes:
        frames: numbers of the frames that show the object. images: RGB in [0, 1].
        K, world_to_camera: of the crops' own cameras.
        masks: the object's. hidden: pixels of the person or of other objects that may hide a part
            of it, and those beyond the image.
        outside: pixels from the nearest one on which the object may be: its own, or hidden ones.
        edges: pixels of the mask's outline against the background, repeated to a fixed number.
    """

    frames: np.ndarray
    images: Float[Tensor, "C 3 S S"]
    K: Float[Tensor, "C 3 3"]
    world_to_camera: Float[Tensor, "C 4 4"]
    masks: Float[Tensor, "C 1 S S"]
    hidden: Float[Tensor, "C 1 S S"]
    outside: Float[Tensor, "C 1 S S"]
    edges: Float[Tensor, "C E 2"]
    edge_weights: Float[Tensor, " C"]

    def rows(self, rows: np.ndarray) -> Crops:
        """Some of the crops."""
        return Crops(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    @property
    def size(self) -> int:
        return self.images.shape[-1]

    def __len__(self) -> int:
        return len(self.frames)

    def project(
        self, points: Float[Tensor, "C P 3"]
    ) -> tuple[Float[Tensor, "C P 2"], Float[Tensor, "C P"]]:
        """Pixels of world points in the crop of each frame, and their depth."""
        view = self.world_to_camera
        seen = points @ view[:, :3, :3].mT + view[:, None, :3, 3]
        depth = seen[..., 2].clamp_min(0.05)
        xy = seen[..., :2] / depth[..., None]
        focal = torch.stack((self.K[:, 0, 0], self.K[:, 1, 1]), -1)
        return xy * focal[:, None] + self.K[:, None, :2, 2], depth

    def centers(self) -> Float[Tensor, "C 3"]:
        """Of the cameras."""
        view = self.world_to_camera
        return -(view[:, :3, :3].mT @ view[:, :3, 3:])[..., 0]

    def middles(self, rows: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """Unit rays through the middles of the masks' boxes, world."""
        found = []
        for row in rows.tolist():
            y, x = self.masks[row, 0].nonzero().double().T.numpy() + 0.5
            middle = np.array([(x.min() + x.max()) / 2, (y.min() + y.max()) / 2, 1.0])
            ray = np.linalg.solve(self.K[row].double().numpy(), middle)
            ray = self.world_to_camera[row, :3, :3].double().numpy().T @ ray
            found.append(ray / np.linalg.norm(ray))
        return np.stack(found)

    def sample(self, maps: Float[Tensor, "C D S S"], xy: Float[Tensor, "C P 2"]) -> Tensor:
        """Bilinear values [C P D] of maps at pixels; those of the border beyond it."""
        grid = (xy / self.size * 2 - 1)[:, None]
        values = torch.nn.functional.grid_sample(
            maps, grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        return values[:, :, 0].mT

    def features(self, blur: float) -> Float[Tensor, "C D S S"]:
        """Log colours between two blurs, of the object alone: texture without its lighting."""
        logs = torch.log(self.images + DARK)
        fine = _masked_blur(logs, self.masks, blur)
        return fine - _masked_blur(logs, self.masks, 4 * blur + 2)

    def hues(self, blur: float) -> Float[Tensor, "C D S S"]:
        """Log ratios of colours, which neither shading nor other sides beside a point change, and
        brightness between two blurs, which is all that something grey has."""
        logs = _masked_blur(torch.log(self.images + DARK), self.masks, blur)
        light = self.features(blur).mean(1, keepdim=True)
        return torch.cat((logs[:, :1] - logs[:, 1:2], logs[:, 2:] - logs[:, 1:2], light), 1)

    def contrast(self, blur: float) -> float:
        """Relative variation of brightness within the object."""
        maps = self.features(blur).mean(1, keepdim=True)
        return float(maps[self.masks > 0].std())


def make_crops(
    filmed: Filmed,
    shown: Bool[np.ndarray, " F"],
    size: int,
    body: Float[Tensor, "F B 3"],
    behind: Float[np.ndarray, " F"],
) -> Crops:
    """Crops of the frames in `shown`, `size` pixels wide (an object is 0.6 of that).

    Args:
        body: points of the person, world, metres. behind: depths from which on the person is
            behind all of the object, and hides nothing of it.
    """
    masks, humans, others, cameras = filmed.masks, filmed.humans, filmed.others, filmed.cameras
    boxes = _boxes(masks, shown)
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("image", "K", "view", "mask", "hidden", "outside", "edges", "share")
    }
    for i, image in enumerate(filmed.images()):
        if not shown[i]:
            continue
        box = boxes[i]
        scale = size / (box[2] - box[0])
        mask = _cut(masks[i], box, size)
        inside = _cut(np.ones_like(masks[i]), box, size)
        K = cameras[i].K.double().numpy().copy()
        K[:2, 2] -= box[:2]
        K[:2] *= scale
        person = _cut(humans[i], box, size) & ~mask
        depths = _nearest_depths(person, K, cameras[i].to_camera(body[i]))
        hidden = person & (depths < behind[i]) | _cut(others[i], box, size) & ~mask
        cut = Image.fromarray(image).crop(tuple(box.round().astype(int)))
        edges, share = _edges(mask, hidden | ~inside, i)
        rows["image"].append(np.asarray(cut.resize((size, size), Image.Resampling.BOX)) / 255.0)
        rows["K"].append(K)
        rows["view"].append(cameras[i].world_to_camera.double().numpy())
        rows["mask"].append(mask)
        rows["hidden"].append(hidden | ~inside)
        rows["outside"].append(ndimage.distance_transform_edt(~(mask | hidden) & inside))
        rows["edges"].append(edges)
        rows["share"].append(np.array(share))
    stacks = {name: torch.from_numpy(np.stack(v)).float() for name, v in rows.items()}
    return Crops(
        np.flatnonzero(shown),
        stacks["image"].permute(0, 3, 1, 2).contiguous(),
        stacks["K"],
        stacks["view"],
        stacks["mask"][:, None],
        stacks["hidden"][:, None],
        stacks["outside"][:, None],
        stacks["edges"],
        stacks["share"],
    )


def _boxes(masks: MaskStack, shown: Bool[np.ndarray, " F"]) -> Float[np.ndarray, "F 4"]:
    """Square boxes about the masks, whole pixels: left, top, right, bottom."""
    found = np.zeros((len(masks), 3))
    for i in np.flatnonzero(shown).tolist():
        rows, columns = np.nonzero(masks[i])
        x, y = (columns.min() + columns.max() + 1) / 2, (rows.min() + rows.max() + 1) / 2
        found[i] = x, y, max(np.ptp(rows), np.ptp(columns)) + 1
    found = fill_gaps(found, shown)
    half = np.ceil(MARGIN * found[:, 2:] / 2)
    centers = found[:, :2].round()
    return np.concatenate((centers - half, centers + half), -1)


def _cut(mask: Bool[np.ndarray, "H W"], box: Float[np.ndarray, " 4"], size: int) -> np.ndarray:
    """A mask's part in a box, resized; nothing outside the image."""
    cut = Image.fromarray(mask.astype(np.uint8) * 255).crop(tuple(box.round().astype(int)))
    return np.asarray(cut.resize((size, size), Image.Resampling.BILINEAR)) > 127


def _nearest_depths(
    pixels: Bool[np.ndarray, "S S"], K: Float[np.ndarray, "3 3"], body: Float[Tensor, "B 3"]
) -> Float[np.ndarray, "S S"]:
    """Depth of the person at some pixels: the least of the points within `LIMB` in the image, or
    that of the nearest point; infinite elsewhere."""
    depths = np.full(pixels.shape, np.inf)
    rows, columns = np.nonzero(pixels)
    seen = body.double().numpy()
    seen = seen[seen[:, 2] > NEAR]
    if not len(rows) or not len(seen):
        return np.where(pixels, 0.0, depths)
    xy = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    away = cdist(np.stack((columns, rows), -1) + 0.5, xy) / K[0, 0] * seen[:, 2]
    close = away <= np.maximum(away.min(1, keepdims=True), LIMB)
    depths[rows, columns] = np.where(close, seen[:, 2], np.inf).min(1)
    return depths


def _edges(
    mask: Bool[np.ndarray, "S S"], hidden: Bool[np.ndarray, "S S"], seed: int
) -> tuple[Float[np.ndarray, "E 2"], float]:
    """Pixels of the outline that border on the background, and their share of the outline."""
    border = mask & ~ndimage.binary_erosion(mask)
    sure = border & ~ndimage.binary_dilation(hidden, iterations=2)
    rows, columns = np.nonzero(sure)
    if len(rows) < 8:
        return np.zeros((EDGES, 2)), 0.0
    chosen = np.random.default_rng(seed).choice(len(rows), EDGES, replace=len(rows) < EDGES)
    xy = np.stack((columns, rows), -1)[chosen] + 0.5
    return xy, len(rows) / max(1, int(border.sum()))


def _masked_blur(
    values: Float[Tensor, "C D S S"], masks: Float[Tensor, "C 1 S S"], sigma: float
) -> Float[Tensor, "C D S S"]:
    """Gaussian blur of what lies inside the masks, which nothing outside enters."""
    radius = max(1, round(2.5 * sigma))
    line = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / max(sigma, 0.3)) ** 2)
    line = line / line.sum()

    def blurred(maps: Tensor) -> Tensor:
        flat = maps.flatten(0, 1)[:, None]
        flat = torch.nn.functional.conv2d(flat, line[None, None, None], padding=(0, radius))
        flat = torch.nn.functional.conv2d(flat, line[None, None, :, None], padding=(radius, 0))
        return flat[:, 0].unflatten(0, maps.shape[:2])

    return blurred(values * masks) / blurred(masks).clamp_min(1e-3)


Level = tuple[float, int, int]  # blur of the texture, pixels; frames a knot of the motion; steps
LEVELS: tuple[Level, ...] = ((5.0, 8, 120), (2.5, 3, 120), (1.2, 1, 160))
SAMPLES = 1200
FACING = 0.2  # cosine between normal and view from which a point counts as seen
TURN_RATE, SHIFT_RATE, SHAPE_RATE = 0.02, 0.01, 0.004
ACCELERATION, SPIN = 6.0, 40.0  # metres and radians a second squared that cost one unit
OUTLINE, HAND, REST = 0.006, 0.03, 0.004  # metres off that cost one unit
REST_TURN = 0.03  # of a rotation matrix, likewise
PHOTO, HANDS, SMOOTH, BEND, SHRINK = 1.0, 0.4, 0.02, 2.0, 2.0


@dataclass(frozen=True)
class Poses:
    """Object to world in the crops' frames."""

    rotations: Float[Tensor, "C 3 3"]
    translations: Float[Tensor, "C 3"]

    def rows(self, rows: np.ndarray) -> Poses:
        return Poses(self.rotations[rows], self.translations[rows])

    def place(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, "C P 3"]:
        return points @ self.rotations.mT + self.translations[:, None]


@dataclass(frozen=True)
class Held:
    """Points that hold the object, such as palms: each keeps its place on it within a grasp.

    Attributes:
        points: world, metres. grasps: number of the grasp that each belongs to, -1 for none.
        rests: number of the rest that each frame belongs to, -1 for none: the pose is constant in
            it, so that a camera that moves sees how far off the object is.
    """

    points: Float[Tensor, "C N 3"]
    grasps: Int[Tensor, "C N"]
    rests: Int[Tensor, " C"]

    def rows(self, rows: np.ndarray) -> Held:
        return Held(self.points[rows], self.grasps[rows], self.rests[rows])

    def offsets(self, poses: Poses) -> Float[Tensor, " N"]:
        """Robust squared distances, in units of `HAND`, from their mean places on the object."""
        local = (self.points - poses.translations[:, None]) @ poses.rotations
        total = local.new_zeros(())
        count = 0
        for column in range(local.shape[1]):
            for grasp in self.grasps[:, column].unique().tolist():
                rows = self.grasps[:, column] == grasp
                if grasp < 0 or int(rows.sum()) < 3:
                    continue
                off = local[rows, column] - local[rows, column].median(0).values.detach()
                total = total + _robust((off / HAND).square().sum(-1)).sum()
                count += int(rows.sum())
        return total / max(1, count)

    def moved(self, poses: Poses) -> Float[Tensor, ""]:
        """Robust squared distances, in units, from the mean pose of each rest."""
        total = poses.translations.new_zeros(())
        for rest in self.rests.unique().tolist():
            rows = self.rests == rest
            if rest < 0 or int(rows.sum()) < 2:
                continue
            for values, unit in ((poses.translations, REST), (poses.rotations, REST_TURN)):
                off = (values[rows] - values[rows].mean(0)).flatten(1) / unit
                total = total + _robust(off.square().sum(-1)).sum()
        return total / len(self.rests)


@dataclass(frozen=True)
class Surface:
    """A closed mesh and points on it.

    Attributes:
        rest: vertices before the alignment moved them. faces: counter-clockwise from outside.
        corners, weights: of the points: the face's corners and barycentric weights.
        neighbours: of each vertex, padded with itself. degree: how many there are.
    """

    rest: Float[Tensor, "V 3"]
    faces: Int[Tensor, "T 3"]
    corners: Int[Tensor, "P 3"]
    weights: Float[Tensor, "P 3"]
    edges: Int[Tensor, "E 2"]

    def points(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "P 3"]:
        return (vertices[self.corners] * self.weights[..., None]).sum(1)

    def normals(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "P 3"]:
        """Of the points, outwards."""
        found = (self.vertex_normals(vertices)[self.corners] * self.weights[..., None]).sum(1)
        return torch.nn.functional.normalize(found, dim=-1)

    def vertex_normals(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """Outwards: of the faces around, by area."""
        a, b, c = (vertices[self.faces[:, i]] for i in range(3))
        flat = torch.linalg.cross(b - a, c - a)
        smooth = torch.zeros_like(vertices)
        for corner in range(3):
            smooth = smooth.index_add(0, self.faces[:, corner], flat)
        return torch.nn.functional.normalize(smooth, dim=-1)

    def area(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, ""]:
        a, b, c = (vertices[self.faces[:, i]] for i in range(3))
        return torch.linalg.cross(b - a, c - a).norm(dim=-1).sum() / 2

    def bends(self, vertices: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3"]:
        """From each vertex to the middle of its neighbours."""
        one, two = self.edges.T
        total = torch.zeros_like(vertices).index_add(0, one, vertices[two])
        total = total.index_add(0, two, vertices[one])
        degree = torch.bincount(self.edges.flatten(), minlength=len(vertices))
        return total / degree[:, None] - vertices


@dataclass(frozen=True)
class Aligned:
    """Result of `align`.

    Attributes:
        frames: numbers of the frames.
        agreement: of each frame, correlation of its texture with that of the others at the points
            that it shows; NaN where it shows hardly any. outline: metres that the mask's outline
            and the mesh's disagree by, mean. cost: mean energy, to compare starts by.
    """

    frames: np.ndarray
    poses: Poses
    vertices: Float[Tensor, "V 3"]
    agreement: Float[np.ndarray, " C"]
    outline: Float[np.ndarray, " C"]
    cost: float


@dataclass(frozen=True)
class Effort:
    """Blur, frames between knots and steps of each level; whether the shape is found, too; and
    what is told how much is done."""

    levels: Sequence[Level] = LEVELS
    shape: bool = True
    progress: Callable[[float], None] = lambda done: None


def align(
    crops: Crops,
    surface: Surface,
    start: Poses,
    held: Held,
    fps: float,
    effort: Effort,
) -> Aligned:
    """Poses and shape from a start, coarse to fine: blurred texture and few knots at first."""
    levels, shape, progress = effort.levels, effort.shape, effort.progress
    problem = _Problem(crops, surface, held, fps)
    poses, vertices = start, surface.rest.clone()
    total, done = sum(steps for _, _, steps in levels), 0
    for blur, knot, steps in levels:
        problem.set_blur(blur)
        # weights of linear interpolation between knots every `knot` frames
        frames = crops.frames
        knots = np.arange(frames[0], frames[-1] + knot, knot)
        weights = np.clip(1 - np.abs(frames[:, None] - knots[None]) / knot, 0, None)
        hats = torch.from_numpy(weights).float()
        turns = torch.zeros(hats.shape[1], 3, requires_grad=True)
        shifts = torch.zeros(hats.shape[1], 3, requires_grad=True)
        moved = torch.zeros_like(vertices, requires_grad=shape)
        groups = [
            {"params": [turns], "lr": TURN_RATE * knot**0.5},
            {"params": [shifts], "lr": SHIFT_RATE * knot**0.5},
        ]
        if shape:
            groups.append({"params": [moved], "lr": SHAPE_RATE})
        adam = torch.optim.Adam(groups, betas=(0.9, 0.98))
        decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.1 ** (1 / steps))
        base, rest = poses, vertices
        for step in range(steps):
            poses = Poses(
                axis_angle_to_matrices(hats @ turns) @ base.rotations,
                base.translations + hats @ shifts,
            )
            vertices = rest + moved
            if step % 10 == 0:
                problem.look(poses, vertices)
            adam.zero_grad()
            problem.energy(poses, vertices).backward()
            adam.step()
            decay.step()
            done += 1
            if progress is not None:
                progress(done / total)
        poses = Poses(poses.rotations.detach(), poses.translations.detach())
        vertices = vertices.detach()
    with torch.no_grad():
        problem.look(poses, vertices)
        return Aligned(crops.frames, poses, vertices, *problem.judged(poses, vertices))


class _Problem:
    """The energy of poses and vertices. `look` finds what is seen, which then stays for a while."""

    def __init__(self, crops: Crops, surface: Surface, held: Held, fps: float) -> None:
        self.crops, self.surface, self.held = crops, surface, held
        self.times = torch.from_numpy(crops.frames / fps).float()
        self.size = float(surface.rest.norm(dim=-1).mean())

    def set_blur(self, blur: float) -> None:
        crops = self.crops
        maps = crops.features(blur)
        inside = crops.masks.expand_as(maps) > 0
        self.spread = float(maps[inside].std().clamp_min(1e-3))
        # the outside grows by the blur, so that a point near the edge counts as little as its map
        self.maps = torch.cat((maps / self.spread, crops.masks, crops.outside), 1)

    @torch.no_grad()
    def look(self, poses: Poses, vertices: Tensor) -> None:
        """Which points each frame shows, and which of them is nearest to each edge pixel."""
        points, normals = self.surface.points(vertices), self.surface.normals(vertices)
        world = poses.place(points)
        toward = self.crops.centers()[:, None] - world
        toward = torch.nn.functional.normalize(toward, dim=-1)
        cosine = ((normals @ poses.rotations.mT) * toward).sum(-1)
        self.seen = ((cosine - FACING) / 0.3).clamp(0, 1)
        xy, _ = self.crops.project(world)
        self.nearest = torch.cdist(self.crops.edges, xy).argmin(-1)

    def energy(self, poses: Poses, vertices: Tensor) -> Tensor:
        photo, outside, reach, _ = self._parts(poses, vertices)
        weight = self.crops.edge_weights
        outline = _robust(outside.square()).mean()
        outline = outline + (_robust(reach.square()).mean(-1) * weight).mean()
        bends = self.surface.bends(vertices) / self.size
        area = self.surface.area(vertices) / self.size**2
        return (
            PHOTO * photo.mean()
            + outline
            + HANDS * self.held.offsets(poses)
            + self.held.moved(poses)
            + SMOOTH * jerks(self.times, poses)
            + BEND * bends.square().sum(-1).mean() * len(vertices) / 100
            + SHRINK * area / 100
        )

    def _parts(self, poses: Poses, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Variance of texture by frame, metres of points outside, and of the outline not reached,
        in units; and the correlation of texture by frame."""
        points = self.surface.points(vertices)
        xy, depth = self.crops.project(poses.place(points))
        values = self.crops.sample(self.maps, xy)
        texture, mask, outside = values[..., :3], values[..., 3], values[..., 4]
        focal = self.crops.K[:, 0, 0]
        pixel = (depth.mean(-1) / focal).detach()[:, None]  # metres
        weight = (self.seen * mask.detach().clamp(0, 1).square())[..., None]
        total = weight.sum(0)
        mean = (weight * texture).sum(0) / total.clamp_min(1e-3)
        alone = total < 1.5
        weight = torch.where(alone, 0.0, weight)
        off = (texture - mean).square().sum(-1)
        share = weight[..., 0].sum(-1).clamp_min(1.0)
        photo = (weight[..., 0] * off / (off.detach() + 3.0).sqrt()).sum(-1) / share
        gap = self.crops.edges - torch.gather(xy, 1, self.nearest[..., None].expand(-1, -1, 2))
        reach = gap.norm(dim=-1) * pixel / OUTLINE
        # leave-one-out means, so that a frame does not agree with itself
        with torch.no_grad():
            others = (total * mean - weight * texture) / (total - weight).clamp_min(1e-3)
            dot = (weight * texture * others).sum((1, 2))
            norms = (weight * texture.square()).sum((1, 2)) * (weight * others.square()).sum((1, 2))
            agreement = dot / norms.clamp_min(1e-9).sqrt()
            agreement[weight[..., 0].sum(-1) < 20] = torch.nan
        return photo, outside * pixel / OUTLINE, reach, agreement

    def judged(
        self, poses: Poses, vertices: Tensor
    ) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, " C"], float]:
        _, outside, reach, agreement = self._parts(poses, vertices)
        outline = OUTLINE * (outside.mean(-1) + reach.mean(-1))
        return agreement.numpy(), outline.numpy(), float(self.energy(poses, vertices))


def jerks(times: Float[Tensor, " C"], poses: Poses) -> Tensor:
    """Mean square accelerations, in units, over gaps of any length; times in seconds."""
    gaps = times.diff()
    if len(gaps) < 2:
        return poses.translations.new_zeros(())
    middle = (gaps[1:] + gaps[:-1])[:, None] / 2
    speed = poses.translations.diff(dim=0) / gaps[:, None]
    turn = poses.rotations[1:] @ poses.rotations[:-1].mT
    spin = _small_log(turn) / gaps[:, None]
    linear = speed.diff(dim=0) / middle / ACCELERATION
    angular = spin.diff(dim=0) / middle / SPIN
    return _robust(linear.square().sum(-1)).mean() + _robust(angular.square().sum(-1)).mean()


def _robust(squares: Tensor) -> Tensor:
    """Square near zero, linear far off (Charbonnier)."""
    return 2 * ((1 + squares).sqrt() - 1)


def _small_log(turns: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3"]:
    """Axis-angle of rotations well under half a turn, smooth at none."""
    skew = torch.stack(
        (
            turns[:, 2, 1] - turns[:, 1, 2],
            turns[:, 0, 2] - turns[:, 2, 0],
            turns[:, 1, 0] - turns[:, 0, 1],
        ),
        -1,
    )
    sine = skew.norm(dim=-1, keepdim=True) / 2
    cosine = (turns.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    angle = torch.atan2(sine, cosine)
    return skew / 2 * torch.where(sine > 1e-4, angle / sine.clamp_min(1e-4), 1.0)
