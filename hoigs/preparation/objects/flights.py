"""Poses in flight: free fall and a constant spin between two known poses, by masks and texture.

In flight an object may turn by more than half a turn, about any axis, and show sides that nothing
has shown before. Every spin is tried that ends at the next known rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.preparation.objects.alignment import Aligned, Poses, Surface
from hoigs.preparation.objects.crops import Crops
from hoigs.preparation.objects.search import (
    APART,
    RATE,
    REFINED,
    STEPS,
    TextureSearch,
    distances_of,
)

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
