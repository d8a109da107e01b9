"""Which way is up in a clip: by vertical lines of the room, checked by the people in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from hoigs.core.model.standing import world_of_people
from hoigs.core.values.camera import Camera
from hoigs.core.values.world import World
from hoigs.preparation.draft import Draft
from hoigs.preparation.video.pictures import shrink, shrink_mask

WIDTH, LEAST = 640, 320  # pixels, at which lines are looked for, and below which they are not
SIGMA, COHERENT = 1.2, 0.85  # pixels, of gradients; of their directions nearby, for a straight line
EDGES = 4000  # pixels; more change nothing
STEEP, STRONG = 0.5, 0.85  # x of an edge's normal; quantile of gradients
NEAR = math.radians(1.5)  # between an edge and the line to the vanishing point
TILTS, ROLLS = np.arange(-50.0, 51.0), np.arange(-20.0, 21.0)  # degrees of the camera, tried
BLOCKS, DRAWS = (6, 8), 60  # of the picture, drawn anew with replacement
ALL = 0.9  # of the draws lie in the interval
DISTINCT = 3.0  # times as many edges as point to where most tilts and rolls have the vertical
CLEAR = 6.0  # degrees: a wider interval tells nothing
FRAMES = 3
LEGS, LEGS_GUESSED = ("left leg", "right leg"), 0.5  # of the frames
LEAN = 30.0  # degrees that somebody's trunk may lean, on average: beyond, lines are not vertical


@dataclass(frozen=True)
class Upright:
    """Up in the world's axes, unit, and the angle within which it is, in degrees."""

    up: Float[np.ndarray, " 3"]
    within: float


def world_of(draft: Draft, focal_range: tuple[float, float] | None) -> World:
    """Up and floor of the clip's world, by what knows best: feet that stood in several places,
    vertical lines of the room, people who stand, or else the cameras, which is a guess.

    Args:
        focal_range: shortest and longest focal length that is possible, as shares of the cameras'.
    """
    count = len(draft.video)
    people = [
        (draft.body, person.poses)
        for name, person in draft.bodies.items()
        if all(len(draft.guessed[name][leg]) < LEGS_GUESSED * count for leg in LEGS)
    ]  # legs that nothing shows are drawn straight, as of somebody who stands
    stood = world_of_people(people, draft.video.fps) if people else None
    if stood is not None and stood.known == "floor":
        return stood
    trunks = [person.joints[:, 12] - person.joints[:, 0] for person in draft.bodies.values()]
    if not trunks:  # the lines of a mat that is seen from above look vertical, too
        return World.guessed(draft.cameras)
    lines = lines_up(draft, focal_range)
    if stood is None:
        trunk, most, clear = np.concatenate([t.numpy() for t in trunks]).mean(0), LEAN, LEAN / 2
    else:  # lines have to be surer by far, and agree
        body = stood.within or 0.0
        trunk, most, clear = np.array(stood.up), 1.5 * body, body / 2
    if lines is None or lines.within > clear or _degrees(lines.up, trunk) > most:
        return World.guessed(draft.cameras) if stood is None else stood
    x, y, z = lines.up.tolist()
    found = World((x, y, z), None, True, "lines", round(lines.within, 1))
    if stood is None or stood.floor is None:
        return found
    # the feet are where they were, and the floor is tilted about them
    middle = draft.bodies[next(iter(draft.bodies))].joints[:, 7:9].mean((0, 1)).double().numpy()
    height = float(middle @ np.array(stood.up)) - stood.floor
    return replace(found, floor=float(middle @ lines.up) - height)


def lines_up(draft: Draft, focal_range: tuple[float, float] | None) -> Upright | None:
    """The median over some frames of `room_up`; None unless most show clear lines, and alike."""
    places = (
        np.linspace(0, len(draft.video) - 1, min(FRAMES, len(draft.video))).astype(int).tolist()
    )
    found: list[Upright] = []
    for place, image in zip(places, draft.video.subset(places), strict=True):
        camera = draft.cameras[place]
        seen = room_up(draft.track.undistort.image(image), draft.masks.moving(place), camera)
        if seen is not None:
            turned = camera.world_to_camera[:3, :3].double().numpy().T @ seen.up
            spread = _by_focal(seen.up, focal_range)
            found.append(Upright(turned, math.hypot(seen.within, spread)))
    if len(found) <= len(places) // 2:
        return None
    ups = np.stack([one.up for one in found])
    up = np.median(ups, axis=0)
    up /= np.linalg.norm(up)
    apart = max(_degrees(one, up) for one in ups)
    return Upright(up, max(apart, *(one.within for one in found))) if apart < CLEAR else None


def room_up(
    image: UInt8[np.ndarray, "H W 3"], hidden: Bool[np.ndarray, "H W"], camera: Camera
) -> Upright | None:
    """Up in a camera's axes by the lines that meet in the vertical vanishing point.

    For each tilt and roll of the camera, edges are counted that point to where its vertical lines
    would meet (as Coughlan and Yuille 2003 do for all three directions). The interval is that of
    the best tilt and roll where parts of the picture are drawn anew (Efron 1979).

    Returns:
        None if no direction is clear.
    """
    if image.shape[1] < LEAST:
        return None
    size = (WIDTH, max(1, round(image.shape[0] * WIDTH / image.shape[1])))
    grey = shrink(image, *size).astype(float).mean(-1)
    places, normals, weights = _edges(grey, shrink_mask(hidden, *size))
    K = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0]) @ camera.K.double().numpy()
    tilt, roll = (np.radians(v) for v in np.meshgrid(TILTS, ROLLS, indexing="ij"))
    ups = np.stack(
        (np.sin(roll) * np.cos(tilt), -np.cos(roll) * np.cos(tilt), np.sin(tilt)), -1
    ).reshape(-1, 3)
    points = ups @ K.T
    rows, columns = BLOCKS
    block = (places[:, 1] * rows // size[1]).astype(int) * columns
    block += (places[:, 0] * columns // size[0]).astype(int)
    weighted = np.zeros((len(places), rows * columns))
    weighted[np.arange(len(places)), block] = weights
    # distance of an edge's line from a vanishing point, over the distance of both: a sine
    line = np.concatenate((normals, -(normals * places).sum(1, keepdims=True)), 1).T
    square = np.concatenate((places, (places**2).sum(1, keepdims=True)), 1).T
    counts = np.zeros((len(ups), rows * columns))
    for part in np.array_split(np.arange(len(ups)), len(TILTS)):
        x, y, z = points[part].T[:, :, None]
        apart = (x**2 + y**2) - 2 * z * (x * square[0] + y * square[1]) + z**2 * square[2]
        sines = (points[part] @ line) ** 2 / apart.clip(1e-6)
        counts[part] = np.exp(-0.5 * sines / NEAR**2) @ weighted
    draw = np.random.default_rng(0)
    found = [ups[_best(counts.sum(1))]]
    shares = np.full(rows * columns, 1 / (rows * columns))
    found += [ups[_best(counts @ draw.multinomial(rows * columns, shares))] for _ in range(DRAWS)]
    up, total = found[0], counts.sum(1)
    at = np.unravel_index(_best(total), (len(TILTS), len(ROLLS)))
    inside = 0 < at[0] < len(TILTS) - 1 and 0 < at[1] < len(ROLLS) - 1
    if not inside or total.max() < DISTINCT * np.median(total):
        return None
    within = float(np.quantile([_degrees(one, up) for one in found[1:]], ALL)) + 0.5  # of the grid
    return Upright(up, within) if within < CLEAR else None


def _edges(
    grey: Float[np.ndarray, "H W"], hidden: Bool[np.ndarray, "H W"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of pixels on steep straight edges, [N, 2], their unit normals, and weights."""
    x, y = (ndimage.gaussian_filter(grey, SIGMA, order=o) for o in ((0, 1), (1, 0)))
    size = np.hypot(x, y)
    least = max(float(np.quantile(size, STRONG)), 1.0)
    xx, xy, yy = (ndimage.gaussian_filter(v, 2 * SIGMA) for v in (x * x, x * y, y * y))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    coherent = np.hypot(xx - yy, 2 * xy) / (xx + yy + 1e-9)
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    normal = np.stack((np.cos(angle), np.sin(angle)), -1)
    beside = [
        ndimage.map_coordinates(
            size, [rows + s * normal[..., 1], columns + s * normal[..., 0]], order=1
        )
        for s in (-1, 1)
    ]
    kept = (size > least) & (size >= beside[0]) & (size >= beside[1]) & (coherent > COHERENT)
    kept &= (np.abs(normal[..., 0]) > STEEP) & ~ndimage.binary_dilation(hidden, iterations=6)
    border = 8  # pixels, in which gradients are of the border
    kept[:border] = kept[-border:] = kept[:, :border] = kept[:, -border:] = False
    r, c = np.nonzero(kept)
    some = np.linspace(0, len(r) - 1, min(len(r), EDGES)).astype(int)
    r, c = r[some], c[some]
    return np.stack((c + 0.5, r + 0.5), 1), normal[r, c], np.minimum(size[r, c] / least, 4.0)


def _best(counts: Float[np.ndarray, " T"]) -> int:
    grid = ndimage.gaussian_filter(counts.reshape(len(TILTS), len(ROLLS)), 1.0)
    return int(grid.argmax())


def _by_focal(up: Float[np.ndarray, " 3"], focal_range: tuple[float, float] | None) -> float:
    """Degrees by which the tilt changes over a range of focal lengths, for one vanishing point."""
    if focal_range is None:
        return 0.0
    level = math.hypot(up[0], up[1])
    tilt = math.atan2(up[2], level)
    return max(abs(math.degrees(math.atan2(share * up[2], level) - tilt)) for share in focal_range)


def _degrees(one: Float[np.ndarray, " 3"], other: Sequence[float] | np.ndarray) -> float:
    cosine = float(np.dot(one, other) / (np.linalg.norm(one) * np.linalg.norm(other)))
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
