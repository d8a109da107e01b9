"""Rotations of grasps that hands say nothing of: a search over all rotations, by texture.

An object may be put down on another side than it was taken up from. Where a part of the clip has
given its shape and texture, every rotation is compared with the frames of a grasp.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_axis_angle,
    quats_to_matrices,
)
from hoigs.preparation.objects.alignment import Aligned, Crops, Poses, Surface

TRIED = 1500  # rotations, about 22 degrees apart
POINTS = 300
SURE = 0.5  # cosine between normal and view from which a point's texture counts
BLUR = 3.0
NEUTRAL, UNKNOWN = 2.0, 30.0  # cost of unknown texture, and the points that it counts as
OUTSIDE = 1.5  # cost of a point outside the mask
CLEARLY = 0.8  # of its cost: another rotation has to be better by so much
DEPTHS = (0.7, 1.0)  # tried where the back was never seen, of its breadth and height
LOOKS = 6  # frames of a grasp in which its rotation is looked for
KNOWN = 2.0  # frames that the texture found before counts as
REFINED, STEPS, RATE = 8, 20, 0.06  # the best of the grid, each moved to its own best place first
APART = 0.35  # radians between them


def grasps_by_texture(
    crops: Crops, surface: Surface, first: Aligned, start: Poses, pieces: Int[np.ndarray, " C"]
) -> Poses:
    """Poses of frames in grasps and rests: those of `first`, and of other pieces by texture.

    Each piece turns as the hands do (`start`), from a rotation that is found for all of it.
    """
    known = np.isin(crops.frames, first.frames)
    poses = distances_of(crops, start, first, known)
    search = TextureSearch(crops, surface, first, known)
    rotations = poses.rotations.clone()
    for piece in np.unique(pieces[~known]).tolist():
        rows = np.flatnonzero(~known & (pieces == piece))
        middles = poses.translations + start.rotations @ search.middle
        rotations[rows] = search.piece(rows, start.rotations[rows], middles)
    return Poses(rotations, poses.translations)


def distances_of(crops: Crops, start: Poses, first: Aligned, known: np.ndarray) -> Poses:
    """`first` where it is known; elsewhere `start`, farther by as much as `first` is."""
    rotations, translations = start.rotations.clone(), start.translations.clone()
    centers = crops.centers()
    before = (translations - centers)[known].norm(dim=-1)
    after = (first.poses.translations - centers[known]).norm(dim=-1)
    moved = centers + (translations - centers) * (after / before).median()
    translations[~known] = moved[~known]
    rotations[known], translations[known] = first.poses.rotations, first.poses.translations
    return Poses(rotations, translations)


class TextureSearch:
    """Costs of rotations in frames, against the texture that an alignment has found."""

    def __init__(self, crops: Crops, surface: Surface, first: Aligned, known: np.ndarray) -> None:
        step = -(-len(surface.corners) // POINTS)
        self.points = surface.points(first.vertices)[::step]
        self.normals = surface.normals(first.vertices)[::step]
        features = crops.hues(BLUR)
        features = features / features[crops.masks.expand_as(features) > 0].std()
        self.maps = torch.cat((features, crops.masks, crops.hidden), 1)
        self.crops, self.grid = crops, _rotations(TRIED)
        part = crops.rows(np.flatnonzero(known))
        world = first.poses.place(self.points)
        values = part.sample(self.maps[known], part.project(world)[0])
        seen = self._facing(part.centers()[:, None] - world, first.poses.rotations)
        weight = (seen * values[..., 3])[..., None]
        self.known = weight.sum(0)[:, 0] > 1.5
        self.texture = (weight * values[..., :3]).sum(0) / weight.sum(0).clamp_min(1e-3)

        toward = (part.centers() - first.poses.translations)[:, None] @ first.poses.rotations
        self.front = torch.nn.functional.normalize(toward.mean((0, 1)), dim=-1)

    def depths(self) -> list[TextureSearch]:
        """Stretched to each of `DEPTHS` that it is not as deep as yet; itself if there is none."""
        found = [self.stretched(ratio) for ratio in DEPTHS]
        return [f for f in found if not torch.equal(f.points, self.points)] or [self]

    def stretched(self, ratio: float) -> TextureSearch:
        """The same with what lies behind the seen side drawn out, until the object is `ratio` as
        deep as it is broad and high (geometric mean): a side that was never seen has no place."""
        along = self.points @ self.front
        flat = self.points - along[:, None] * self.front
        broad, high = (2 * torch.pca_lowrank(flat, 2)[1] * (3 / len(flat)) ** 0.5).tolist()
        near, far = along.quantile(0.98), along.quantile(0.02)
        factor = max(1.0, ratio * (broad * high) ** 0.5 / float(near - far))
        found = copy(self)
        found.points = self.points + ((factor - 1) * (along - near))[:, None] * self.front
        into = (self.normals @ self.front)[:, None] * self.front
        found.normals = torch.nn.functional.normalize(self.normals - into + into / factor, dim=-1)
        return found

    @property
    def middle(self) -> Float[Tensor, " 3"]:
        """Of the points' box."""
        return (self.points.amax(0) + self.points.amin(0)) / 2

    def _facing(self, toward: Tensor, rotations: Tensor) -> Tensor:
        toward = torch.nn.functional.normalize(toward, dim=-1)
        return (((self.normals @ rotations.mT) * toward).sum(-1) > SURE).float()

    def samples(
        self, row: int, rotations: Float[Tensor, "R 3 3"], place: Tensor
    ) -> tuple[Float[Tensor, "R P 3"], Float[Tensor, "R P"], Float[Tensor, " R"]]:
        """Texture at the points and whether they show it, and the share of points outside the
        mask; places are moved so that the points' middle is the mask's."""
        one = self.crops.rows(np.array([row]))
        world = (self.points - self.middle) @ rotations.mT + place
        xy, _ = one.project(world.flatten(0, 1)[None])
        xy = xy[0].unflatten(0, world.shape[:2])
        box = (xy.amax(1) + xy.amin(1)) / 2
        rows, columns = one.masks[0, 0].nonzero().T
        middle = torch.stack((columns, rows), -1).float() + 0.5
        middle = (middle.amax(0) + middle.amin(0)) / 2
        xy = xy - box[:, None] + middle
        values = one.sample(self.maps[row : row + 1], xy.flatten(0, 1)[None])[0]
        values = values.unflatten(0, world.shape[:2])
        mask, hidden = values[..., 3], values[..., 4]
        seen = self._facing(one.centers()[:, None] - world, rotations) * (1 - hidden)
        return values[..., :3], seen * mask, ((1 - mask) * (1 - hidden)).mean(-1)

    def costs(self, row: int, rotations: Float[Tensor, "R 3 3"], place: Tensor) -> Tensor:
        """Of rotations in one frame, against the known texture."""
        values, weight, outside = self.samples(row, rotations, place)
        off = (values - self.texture).abs().sum(-1).clamp_max(4.0)
        return _photo(off, weight * self.known) + OUTSIDE * outside

    def costs_together(self, rows: np.ndarray, rotations: list[Tensor], places: Tensor) -> Tensor:
        """Of rotations of several frames, against the known texture and each other's, so that
        sides which nothing has shown before count as soon as two of the frames show them."""
        found = [
            self.samples(r, t, places[r]) for r, t in zip(rows.tolist(), rotations, strict=True)
        ]
        values, weight = (torch.stack([f[i] for f in found]) for i in (0, 1))
        known = (KNOWN * self.known).expand(values.shape[1:3])
        total = weight.sum(0) + known
        mean = (weight[..., None] * values).sum(0) + known[..., None] * self.texture
        others = (total - weight)[..., None]
        expected = (mean - weight[..., None] * values) / others.clamp_min(1e-3)
        off = (values - expected).abs().sum(-1).clamp_max(4.0)
        outside = torch.stack([f[2] for f in found])
        return (_photo(off, weight * (others[..., 0] > 0.5)) + OUTSIDE * outside).sum(0)

    def piece(self, rows: np.ndarray, turns: Tensor, places: Tensor) -> Tensor:
        """Rotations of a grasp that turns as `turns` do, from one that is found."""
        looks = rows[np.linspace(0, len(rows) - 1, min(LOOKS, len(rows))).round().astype(int)]
        ahead = [turns[int(np.flatnonzero(rows == row)[0])] @ turns[0].mT for row in looks]

        def total(rotations: Tensor) -> Tensor:
            costs = [
                self.costs(row, turn @ rotations, places[row])
                for row, turn in zip(looks.tolist(), ahead, strict=True)
            ]
            return torch.stack(costs).sum(0)

        tried = torch.cat((turns[:1], self.grid))
        tried = tried[_distinct(tried, total(tried))]
        moved = torch.zeros(len(tried), 3, requires_grad=True)
        adam = torch.optim.Adam([moved], lr=RATE)
        for _ in range(STEPS):
            adam.zero_grad()
            total(axis_angle_to_matrices(moved) @ tried).sum().backward()
            adam.step()
        with torch.no_grad():
            tried = axis_angle_to_matrices(moved) @ tried
            cost = total(tried)
        cost[0] *= CLEARLY  # as it was let go, unless the texture is clearly against it
        return turns @ turns[0].mT @ tried[cost.argmin()]

    def few(self, step: int) -> TextureSearch:
        """The same with every `step`-th point."""
        found = copy(self)
        for name in ("points", "normals", "known", "texture"):
            setattr(found, name, getattr(self, name)[::step])
        return found


def _photo(off: Float[Tensor, "*R P"], weight: Float[Tensor, "*R P"]) -> Float[Tensor, "*R"]:
    """Mean difference of texture; sides that nothing has shown say nothing for or against."""
    return ((weight * off).sum(-1) + NEUTRAL * UNKNOWN) / (weight.sum(-1) + UNKNOWN)


def _distinct(rotations: Float[Tensor, "R 3 3"], costs: Float[Tensor, " R"]) -> list[int]:
    """The first rotation, and the cheapest others that are apart from each other."""
    kept = [0]
    for i in costs.argsort().tolist():
        cosine = ((rotations[i] * rotations[kept]).sum((-1, -2)) - 1) / 2
        if float(cosine.max()) < np.cos(APART):
            kept.append(i)
        if len(kept) == REFINED:
            break
    return kept


def _rotations(count: int) -> Float[Tensor, "R 3 3"]:
    """Rotations spread over all (super-Fibonacci spiral, Alexa 2022)."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    psi = 1.533751168755204288118041413
    a, b = 2 * torch.pi * s / 2**0.5, 2 * torch.pi * s / psi
    low, high = (s / count).sqrt(), (1 - s / count).sqrt()
    quats = torch.stack((low * a.sin(), low * a.cos(), high * b.sin(), high * b.cos()), -1)
    return quats_to_matrices(quats).float()


SPIN = 9.0  # radians a second in flight that cost one unit
MOST_TURNS, SLACK = 1.3, 0.6  # of a flight; radians between its end and the next known rotation
TURNING = 0.02  # weight of that against the texture
GRAVITY, PULL = 9.81, 0.7  # metres a second squared, and its spread: `up` is 2 degrees off or more
RAY, RELEASE = 0.02, 0.1  # metres: of a ray, of a throw's ends


def flights_by_texture(
    crops: Crops,
    surface: Surface,
    first: Aligned,
    start: Poses,
    up: Float[np.ndarray, " 3"],
    fps: float,
) -> Poses:
    """Poses of all frames: those of `first`, and between them the free fall that the masks agree
    with, and a constant spin found by texture.

    Frames before the first known one and after the last keep its rotation. The poses are those of
    the object's middle, which a flight shows better than the grasps before it.

    Args:
        up: against gravity, unit, world.
    """
    known = np.isin(crops.frames, first.frames)
    poses = distances_of(crops, start, first, known)
    seen = TextureSearch(crops, surface, first, known)
    rotations, places = poses.rotations.clone(), poses.translations.clone()
    chosen: list[Tensor] = []
    for rows in _runs(np.flatnonzero(~known)):
        before, after = rows[0] - 1, rows[-1] + 1
        if before < 0:
            rotations[rows] = rotations[after].clone()
        elif after == len(known):
            rotations[rows] = rotations[before].clone()
        else:
            found: list[tuple[float, Tensor, Tensor, Tensor]] = []
            spins: Tensor | None = None
            for search in seen.depths():
                middles = places + rotations @ search.middle
                middles[rows] = ballistic(crops, middles, rows, up, fps)
                flight = _flight(search, rows, rotations, middles, fps)
                spins = flight.likely() if spins is None else spins
                cost, turns = flight.best(spins)
                middle = search.middle
                found.append((cost, turns, middles[rows] - turns @ middle, middle))
            _, rotations[rows], places[rows], middle = min(found, key=lambda f: f[0])
            chosen.append(middle)
    middle = torch.stack(chosen).mean(0) if chosen else seen.middle
    return Poses(rotations, places + rotations @ middle)


def _flight(
    search: TextureSearch, rows: np.ndarray, rotations: Tensor, places: Tensor, fps: float
) -> _Flight:
    """The rows' spin between two known rotations."""
    frames = search.crops.frames
    first, last = rows[0] - 1, rows[-1] + 1
    seconds = float(frames[last] - frames[first]) / fps
    parts = ((frames[rows] - frames[first]) / (frames[last] - frames[first])).tolist()
    return _Flight(search, rows, places, parts, rotations[first], rotations[last], seconds)


@dataclass(frozen=True)
class _Flight:
    """Spins about a world axis between two known rotations, `first` and `last`; `parts` are the
    rows' parts of the way."""

    search: TextureSearch
    rows: np.ndarray
    places: Float[Tensor, "C 3"]
    parts: list[float]
    first: Float[Tensor, "3 3"]
    last: Float[Tensor, "3 3"]
    seconds: float

    def likely(self) -> Float[Tensor, "N 3"]:
        """The best of all spins up to `MOST_TURNS` that end within `SLACK` of the last rotation."""
        spins = _ball(2 * np.pi * MOST_TURNS)
        spins = spins[self._rest(spins).norm(dim=-1) < SLACK]
        search = self.search.few(3)
        cost = torch.cat([self._cost(part, search) for part in spins.split(400)])
        return spins[_apart(spins, cost)]

    def best(self, spins: Float[Tensor, "N 3"]) -> tuple[float, Float[Tensor, "R 3 3"]]:
        """Cost and rotations of the best of `spins`, each moved to its own best place first."""
        search = self.search.few(2)
        moved = torch.zeros_like(spins, requires_grad=True)
        adam = torch.optim.Adam([moved], lr=RATE)
        for _ in range(STEPS):
            adam.zero_grad()
            self._cost(spins + moved, search).sum().backward()
            adam.step()
        with torch.no_grad():
            cost = self._cost(spins + moved, self.search)
            best = cost.argmin()
            return float(cost[best]), torch.stack([t[best] for t in self._turned(spins + moved)])

    def _rest(self, spins: Tensor) -> Tensor:
        """What a spin lacks of the last rotation, spread over the flight."""
        turned = axis_angle_to_matrices(spins).mT @ self.last @ self.first.mT
        return matrices_to_axis_angle(turned)

    def _turned(self, spins: Tensor) -> list[Tensor]:
        rest = self._rest(spins)
        return [
            axis_angle_to_matrices(p * spins) @ axis_angle_to_matrices(p * rest) @ self.first
            for p in self.parts
        ]

    def _cost(self, spins: Tensor, search: TextureSearch) -> Tensor:
        fast = TURNING * len(self.rows) * (spins.norm(dim=-1) / self.seconds / SPIN).square()
        return fast + search.costs_together(self.rows, self._turned(spins), self.places)


def ballistic(
    crops: Crops,
    places: Float[Tensor, "C 3"],
    rows: np.ndarray,
    up: Float[np.ndarray, " 3"],
    fps: float,
) -> Float[Tensor, "N 3"]:
    """Places of a flight between two known ones: a parabola under gravity, of which the masks show
    the rays through its middles.

    A hand lets go, or catches, at any moment between two frames, and until then it moves the object
    as it likes: the parabola passes the known places only nearly. Linear in its ends p0 and p1 and
    the acceleration a: p(t) = line from p0 to p1 + a (t - t0) (t - t1) / 2.

    Args:
        places: world, metres; only those before and after the flight are read.
        rows: of the flight's crops. up: against gravity, unit, world.
    """
    ends = [rows[0] - 1, rows[-1] + 1]
    times = crops.frames[rows] / fps
    t0, t1 = crops.frames[ends] / fps
    known = places[ends].double().numpy().reshape(-1)
    share, bend = (times - t0) / (t1 - t0), (times - t0) * (times - t1) / 2
    moves = np.stack((1 - share, share, bend), -1)[:, None, :, None] * np.eye(3)[:, None]
    moves = moves.reshape(-1, 3, 9)  # of a place by p0, p1 and a
    centers, rays = crops.centers()[rows].double().numpy(), crops.middles(rows)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # what a ray sees of a shift
    matrix = (across @ moves / RAY).reshape(-1, 9)
    target = np.einsum("nij,nj->ni", across, centers).reshape(-1) / RAY
    spread = np.repeat((RELEASE, PULL), (6, 3))
    matrix = np.concatenate((matrix, np.diag(1 / spread)))
    target = np.concatenate((target, np.concatenate((known, -GRAVITY * up)) / spread))
    found = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return torch.from_numpy(moves @ found).float()


def _apart(spins: Float[Tensor, "R 3"], costs: Float[Tensor, " R"]) -> list[int]:
    """The cheapest spins that are apart from each other."""
    kept: list[int] = []
    for i in costs.argsort().tolist():
        if not kept or float((spins[i] - spins[kept]).norm(dim=-1).min()) > 2 * APART:
            kept.append(i)
        if len(kept) == REFINED:
            break
    return kept


def _ball(radius: float, step: float = 0.6) -> Float[Tensor, "N 3"]:
    """Vectors of a grid within a ball, none first."""
    count = int(radius / step)
    line = torch.arange(-count, count + 1) * step
    grid = torch.cartesian_prod(line, line, line)
    grid = grid[grid.norm(dim=-1) <= radius]
    return grid[grid.norm(dim=-1).argsort()]


def _runs(rows: np.ndarray) -> list[np.ndarray]:
    """Stretches of numbers that follow each other."""
    return [r for r in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1) if len(r)]
