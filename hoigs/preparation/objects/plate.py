"""A flat thing, such as a board, a plate or a racket's head: one plane whose poses its texture and
outline show.

Homographies of one frame to all others come first. Of the plane's two angles, the ones are taken
by which all of them are turns and shifts of it: each homography leaves two equations (Sturm 2000),
which also tell a plane from its mirror image. Plane and poses are then refined against the frames.
All this is known up to one size: a thing that is held has the distance of the hands at it, which
lie in its plane, and keeps its size over the clip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.objects.alignment import Crops, Poses, jerks
from hoigs.preparation.objects.hands import HAND_JOINTS
from hoigs.preparation.objects.laid import FINE, Sheet, laid_over, templates_of, through
from hoigs.preparation.objects.tracked import (
    AGREES,
    ObjectConfidence,
    between,
    over_frames,
    palm_distances,
)
from hoigs.preparation.objects.watched import FEWEST, UntrackableError, Watched

STEEPEST = 75.0  # degrees between the plane's normal and the view of the template
TRIED, APART, PEAKS = 200, 0.25, 3  # normals, radians about each in which it is the best, and best
NEARER = 9  # normals along a side of the square that is tried about a peak
ROUNDS, NEAR, LEAST = 6, 0.02, 1e-5  # of Gauss and Newton; of half a crop; added to their matrix
LEVELS = ((2.5, 12.0), FINE)
STEPS, RATE, SMOOTH = 40, 0.015, 0.02
FARTHEST = 0.3  # radians or metres of a step
# From what the hands at it say of its distance: how far off is wrong, in the median of what all are
# off (4.5: three standard deviations), and at least, of its distance.
OFF, LEAST_OFF = 4.5, 0.05
OVERLAPS = 0.6  # of the picture with a mask, from which it is laid over it
PART = 0.5  # of the frames that show a place: so many have to show the thing there
GRIP = 0.04  # metres between a knuckle of a fitted body and the plane that it holds, about
THIN = 0.01  # of its radius: half its thickness
SIDE = 48  # cells along a side of the plane


@dataclass(frozen=True)
class Planes:
    """Guesses of the plane in the template's camera, normals · x = 1, and of its poses there.

    Attributes:
        middle: where the view through the template's crop meets it, metres. rotations: of each
            frame's camera against the template's. places: of the plane's middle in each.
    """

    normals: Float[Tensor, "N 3"]
    middle: Float[Tensor, " 3"]
    rotations: Float[Tensor, "N C 3 3"]
    places: Float[Tensor, "N C 3"]

    def maps(self, rays: Float[Tensor, "C 3 3"], row: int) -> Float[Tensor, "N C 3 3"]:
        """Homographies from the template's crop to all."""
        shifts = self.places - self.rotations @ self.middle
        moved = self.rotations + shifts[..., None] * self.normals[:, None, None]
        return torch.linalg.inv(rays) @ moved @ rays[row]

    def one(self, k: int) -> Planes:
        rows = slice(k, k + 1)
        return Planes(self.normals[rows], self.middle, self.rotations[rows], self.places[rows])

    def in_world(self, crops: Crops) -> Poses:
        """Turns and places of the first guess."""
        view = crops.world_to_camera
        places = (self.places[0] - view[:, :3, 3])[:, None] @ view[:, :3, :3]
        return Poses(view[:, :3, :3].mT @ self.rotations[0], places[:, 0])

    def moved(self, tilt: Tensor, turns: Tensor, shifts: Tensor) -> Planes:
        """Tilted; turned about its middle; shifted in parts of its distance."""
        normals = self.normals + tilt * self.normals.norm()
        normals = normals / (normals @ self.middle)
        places = self.places + self.places[..., 2:] * shifts
        return Planes(normals, self.middle, axis_angle_to_matrices(turns) @ self.rotations, places)


def plate_object(
    seen: Watched, count: int, progress: Callable[[float], None]
) -> tuple[ObjectTrack, Float[Tensor, "P 3"], float, ObjectConfidence]:
    """Poses and outline of a flat thing.

    Returns:
        the track (grey: colours are sampled afterwards), the points' normals to either side, by
        how much the hands disagree on its size, relative, and how far the track may be trusted

    Raises:
        UntrackableError: its frames are not pictures of one plane.
    """
    crops, hands = seen.crops, seen.hands
    tried: list[tuple[float, int, Planes]] = []
    rows = templates_of(crops)
    for row in rows:
        depth = float(hands.depths[crops.frames[row]])
        off, planes = likeliest(crops, row, laid_over(crops, row), depth)
        tried.append((off, row, planes))
        progress(0.8 * len(tried) / len(rows))
    _, row, planes = min(tried, key=lambda t: t[0])
    planes, share, alike = refined(crops, row, planes, seen.filmed.fps)
    progress(0.9)
    sure = ((alike >= AGREES) & (share >= OVERLAPS)).numpy()
    if int(sure.sum()) < max(FEWEST, PART * len(crops)):
        raise UntrackableError(
            f"{int(sure.sum())} of {len(crops)} frames show the same flat picture as frame "
            f"{crops.frames[row]}"
        )
    size, spread, by = held_size(seen, planes)
    basis = _basis(planes.normals)[0]
    area, flat = _outline(crops, planes, basis, count // 2)
    radius = float(flat.norm(dim=-1).mean())
    middle = (flat.amax(0) + flat.amin(0)) / 2
    thick = THIN * radius * size
    flat = torch.nn.functional.pad(size * (flat - middle), (0, 1))
    sides = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    points = (flat[None] + thick * sides[:, None]).flatten(0, 1)
    normals = sides[:, None].expand(2, len(flat), 3).flatten(0, 1)
    own = torch.cat((basis, torch.linalg.cross(basis[:, 0], basis[:, 1])[:, None]), 1)
    scaled = Planes(planes.normals, planes.middle, planes.rotations, planes.places * size)
    world = scaled.in_world(crops)
    poses = Poses(world.rotations @ own, world.translations)
    shown = np.zeros(len(seen.outlines.observed), bool)
    shown[crops.frames[sure]] = True
    at = torch.nn.functional.pad(size * middle, (0, 1))
    rotations, places = between(poses.rows(np.flatnonzero(sure)), at, shown, hands)
    places = by_masks(seen, shown, places)
    off = size * area**0.5 / 4 * (1 - share)  # of a square as large
    track = ObjectTrack(
        points=points,
        colors=torch.full_like(points, 0.5),
        rotations=rotations,
        translations=places,
        observed=torch.from_numpy(seen.outlines.observed),
        provenance=(
            f"a flat thing: the picture of frame {crops.frames[row]} laid over the others as a "
            f"plane's; rotation known in {int(sure.sum())} of {len(shown)} frames, the others "
            "follow their neighbours, and where they have a mask, it and the hands place them; "
            f"its size by {by}; its outline is what most frames show of it"
        ),
    )
    confidence = ObjectConfidence(
        "texture and hands", over_frames(alike.numpy(), seen.outlines.observed),
        over_frames(off.numpy(), seen.outlines.observed), float(hands.held.mean()),
        float(hands.rests.mean()), palm_distances(hands, points, normals, rotations, places),
    )  # fmt: skip
    return track, normals, spread, confidence


def by_masks(
    seen: Watched, sure: Bool[np.ndarray, " F"], places: Float[Tensor, "F 3"]
) -> Float[Tensor, "F 3"]:
    """Places of the frames with a mask that shows too little of the picture, as where it glares, or
    that puts it far from the hands at it: in the middle of their masks, and as far from the hands
    as in most frames that are sure."""
    cameras, hands = seen.filmed.cameras, seen.hands
    depths = np.array([
        float(camera.to_camera(place)[2]) for camera, place in zip(cameras, places, strict=True)
    ])  # fmt: skip
    held = hands.near.any(1)
    if (sure & held).any():
        ratios = np.log(depths / hands.depths)
        usual = np.median(ratios[sure & held])
        off = np.abs(ratios - usual)
        sure = sure & ~(held & (off > max(LEAST_OFF, OFF * np.median(off[sure & held]))))
        depths = np.where(held, np.exp(usual) * hands.depths, depths)
    found = places.clone()
    for i in np.flatnonzero(seen.outlines.observed & ~sure).tolist():
        middle = torch.from_numpy(seen.outlines.centers[i]).float()
        found[i] = cameras[i].unproject(middle, torch.tensor(float(depths[i])))
    return found


def likeliest(
    crops: Crops, row: int, maps: Float[Tensor, "C 3 3"], depth: float
) -> tuple[float, Planes]:
    """The plane that homographies from one crop to all are most likely of, and the part of them
    that it does not explain; metres.

    Of many normals over the hemisphere the best peaks are sought more finely.
    """
    sheet = Sheet.of(crops, row, FINE)
    _, share, alike = sheet.costs(maps)
    sure = share * alike.clamp_min(0)
    rim = sheet.grid[sheet.mask > 0.5]
    part = torch.cartesian_prod(*2 * [torch.linspace(0, 1, 4)])
    places = torch.lerp(rim.amin(0), rim.amax(0), part)
    rays = _rays(crops)
    view = rays[row] @ torch.tensor([0.0, 0.0, 1.0])
    units = _hemisphere(view)
    total = _fitted(rays, row, maps, units, depth, places)[1] @ sure
    close = units @ units.mT > np.cos(APART)
    peaks = (total <= torch.where(close, total, torch.inf).amin(1)).nonzero().flatten()
    around = APART * torch.cartesian_prod(*2 * [torch.linspace(-1, 1, NEARER)])
    best: tuple[float, Planes] | None = None
    for k in peaks[total[peaks].argsort()][:PEAKS].tolist():
        finer = units[k] + around @ _basis(units[k : k + 1])[0].mT
        finer = torch.nn.functional.normalize(finer, dim=-1)
        planes, off = _fitted(rays, row, maps, finer, depth, places)
        least = (off @ sure).min(0)
        if best is None or float(least.values) < best[0]:
            best = float(least.values), planes.one(int(least.indices))
    assert best is not None  # the best of all is a peak
    return (best[0] + float((1 - sure).sum())) / len(crops), best[1]


def _fitted(
    rays: Float[Tensor, "C 3 3"],
    row: int,
    maps: Float[Tensor, "C 3 3"],
    units: Float[Tensor, "N 3"],
    depth: float,
    places: Float[Tensor, "P 2"],
) -> tuple[Planes, Float[Tensor, "N C"]]:
    """Poses for each normal, by Gauss and Newton on where homographies take some places, and what
    they miss those by, from 0 to 1."""
    view = rays[row] @ torch.tensor([0.0, 0.0, 1.0])
    normals = units / (units @ view)[:, None] / depth
    middle = view * depth
    rotations, at = _split(rays @ maps @ torch.linalg.inv(rays[row]), normals, middle)
    target, lens = through(maps, places), torch.linalg.inv(rays)
    seen = torch.nn.functional.pad(places, (0, 1), value=1.0) @ rays[row].mT
    flat = seen / (normals @ seen.mT)[..., None] - middle  # N P 3
    gaps = torch.zeros(())
    for _ in range(ROUNDS):
        local = flat[:, None] @ rotations.mT
        image = (local + at[:, :, None]) @ lens.mT
        away = image[..., 2:].clamp_min(0.05)
        gaps = target - image[..., :2] / away
        by_place = (lens[:, None, :2] - (target - gaps)[..., None] * lens[:, None, 2:]) / away[
            ..., None
        ]
        by_turn = torch.linalg.cross(local[..., None, :].expand_as(by_place), by_place)
        slope = torch.cat((by_turn, by_place), -1).flatten(2, 3)
        matrix = slope.mT @ slope + LEAST * torch.eye(6)
        step = torch.linalg.solve(matrix, slope.mT @ gaps.flatten(2, 3)[..., None])[..., 0]
        step = step.clamp(-FARTHEST, FARTHEST)
        rotations = axis_angle_to_matrices(step[..., :3]) @ rotations
        at = at + step[..., 3:]
    squares = gaps.square().sum(-1).mean(-1) / NEAR**2
    return Planes(normals, middle, rotations, at), squares / (1 + squares)


def _split(
    maps: Float[Tensor, "C 3 3"], normals: Float[Tensor, "N 3"], middle: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "N C 3 3"], Float[Tensor, "N C 3"]]:
    """Turns and places of the middle nearest to homographies between rays, for some planes.

    A plane's homography is R + t n' up to its sign and size. It takes two directions in the plane
    to those that R takes them to.
    """
    basis = _basis(normals)[:, None]
    seen = maps @ basis
    size = (seen.square().sum((-1, -2)) / 2).sqrt()
    left, _, right = torch.linalg.svd(seen / size[..., None, None], full_matrices=False)
    turned, own = (_completed(b) for b in (left @ right, basis))
    return turned @ own.mT, maps @ middle / size[..., None]


def refined(
    crops: Crops, row: int, planes: Planes, fps: float
) -> tuple[Planes, Float[Tensor, " C"], Float[Tensor, " C"]]:
    """One plane and its poses moved to their best against the frames themselves.

    Returns:
        the plane; overlap with each mask, and correlation with each frame's colours
    """
    rays, count = _rays(crops), len(crops)
    times = torch.from_numpy(crops.frames / fps).float()
    sheet = Sheet.of(crops, row, LEVELS[0])
    for level in LEVELS:
        sheet = Sheet.of(crops, row, level)
        tilt = torch.zeros(3, requires_grad=True)
        turns, shifts = (torch.zeros(1, count, 3, requires_grad=True) for _ in range(2))
        groups = [{"params": [tilt, turns], "lr": RATE}, {"params": [shifts], "lr": RATE / 2}]
        adam = torch.optim.Adam(groups, betas=(0.9, 0.98))
        decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.05 ** (1 / STEPS))
        for _ in range(STEPS):
            adam.zero_grad()
            now = planes.moved(tilt, turns, shifts)
            cost = sheet.costs(now.maps(rays, row)[0])[0].mean()
            (cost + SMOOTH * jerks(times, now.in_world(crops))).backward()
            adam.step()
            decay.step()
        planes = planes.moved(tilt.detach(), turns.detach(), shifts.detach())
    return planes, *sheet.costs(planes.maps(rays, row)[0])[1:]


def held_size(seen: Watched, planes: Planes) -> tuple[float, float, str]:
    """What to enlarge all by, so that the plane goes through the hands at it; what that is off by,
    relative: half of the middle 68 % of what they say, and a grip's width; and by what it is.

    A plane whose tilt is off is too near at one hand and too far at the other: where both hold it,
    they count as one.
    """
    crops, hands, joints = seen.crops, seen.hands, seen.filmed.joints
    normals = (planes.rotations @ planes.normals[0])[0]
    found, both = list[float](), list[float]()
    for i, frame in enumerate(crops.frames.tolist()):
        near = hands.near[frame]
        if joints is None or not near.any():
            continue
        grips = seen.filmed.cameras[frame].to_camera(_grips(joints[frame])[torch.from_numpy(near)])
        on = (normals[i] @ planes.places[0, i]) / (grips / grips[:, 2:] @ normals[i])
        said = [f for f in (grips[:, 2] / on).tolist() if f > 0]
        found += said
        both += [float(np.sqrt(np.prod(said)))] * (len(said) == 2)
    by = f"the hands at it ({len(found)} views of them)"
    if not found:
        by = "its supposed distance"
        found = (hands.depths[crops.frames] / planes.places[0, :, 2].numpy()).tolist()
    low, middle, high = np.quantile(found, (0.16, 0.5, 0.84))
    if len(both) >= FEWEST:
        middle = np.median(both)
    off = np.hypot((high - low) / 2 / middle, GRIP / float(middle * planes.places[0, :, 2].mean()))
    return float(middle), float(off), by


def _grips(joints: Float[Tensor, "J 3"]) -> Float[Tensor, "2 3"]:
    """Where each hand holds something thin: at the root of its index finger."""
    first = len(joints) - HAND_JOINTS
    return joints[[first, first + HAND_JOINTS // 2]]


def _outline(
    crops: Crops, planes: Planes, basis: Float[Tensor, "3 2"], count: int
) -> tuple[float, Float[Tensor, "P 2"]]:
    """Area of the thing, and points spread over it, in the plane's own axes about its middle: the
    places where most of the frames that show the plane show the thing."""
    reach = 0.75 * float(crops.size / crops.K[:, 0, 0].mean() * planes.places[0, :, 2].mean())
    line = torch.linspace(-reach, reach, SIDE)
    cells = torch.cartesian_prod(line, line)
    local = cells @ basis.mT @ planes.rotations[0].mT + planes.places[0][:, None]
    image = local @ crops.K.mT
    xy = image[..., :2] / image[..., 2:].clamp_min(0.05)
    inside = ((xy >= 0) & (xy < crops.size)).all(-1)
    mask, hidden = crops.sample(torch.cat((crops.masks, crops.hidden), 1), xy).unbind(-1)
    mask = torch.where(inside, mask, 0.0)
    free = torch.maximum(mask, 1 - torch.where(inside, hidden, 0.0))
    votes = (mask.sum(0) / free.sum(0).clamp_min(1e-3)).reshape(1, 1, SIDE, SIDE)
    area = float((votes > PART).sum()) * (2 * reach / (SIDE - 1)) ** 2
    if area == 0:
        raise UntrackableError("its masks are not one outline in a plane")
    fine = max(2, round((count / area) ** 0.5 * 2 * reach))
    line = torch.linspace(-1, 1, fine)
    grid = torch.cartesian_prod(line, line)
    # rows of `votes` are the first axis, which grid_sample calls y
    dense = torch.nn.functional.grid_sample(votes, grid.flip(-1)[None, None], align_corners=True)
    return area, reach * grid[dense[0, 0, 0] > PART]


def _rays(crops: Crops) -> Float[Tensor, "C 3 3"]:
    """From a crop's places, -1 to 1, to rays of its camera with z = 1."""
    half = crops.size / 2
    pixels = torch.tensor([[half, 0, half], [0, half, half], [0, 0, 1.0]])
    return torch.linalg.inv(crops.K) @ pixels


def _hemisphere(view: Float[Tensor, " 3"]) -> Float[Tensor, "N 3"]:
    """Unit directions spread evenly within `STEEPEST` of a view."""
    i = torch.arange(TRIED) + 0.5
    z = 1 - i / TRIED * (1 - np.cos(np.radians(STEEPEST)))
    turn, ring = i * np.pi * (3 - 5**0.5), (1 - z * z).sqrt()
    axis = torch.nn.functional.normalize(view, dim=0)
    basis = _basis(axis[None])[0]
    sideways = torch.stack((ring * turn.cos(), ring * turn.sin()), -1) @ basis.mT
    return sideways + z[:, None] * axis


def _basis(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 2"]:
    """Two unit directions across each."""
    return torch.linalg.svd(normals[:, None]).Vh[:, 1:].mT


def _completed(basis: Float[Tensor, "*N 3 2"]) -> Float[Tensor, "*N 3 3"]:
    """With the direction across both."""
    third = torch.linalg.cross(basis[..., 0], basis[..., 1])
    return torch.cat((basis, third[..., None]), -1)
