"""Rotations of frames that hands say nothing of: a search over all rotations, by texture.

In flight an object may turn by more than half a turn, about any axis, and come down on another
side. Where a part of the clip has given its shape and texture, every rotation is compared with each
frame of a grasp; between two grasps the spin is constant, and every spin is tried.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.maths.rotations import (
    axis_angle_to_matrices,
    matrices_to_axis_angle,
    quats_to_matrices,
)
from hoigs.preparation.objects.alignment import Aligned, Poses, Surface
from hoigs.preparation.objects.crops import Crops

TRIED = 1500  # rotations, about 22 degrees apart
POINTS = 300
SURE = 0.5  # cosine between normal and view from which a point's texture counts
BLUR = 3.0
SPIN = 9.0  # radians a second in flight that cost one unit
MOST_TURNS, SLACK = 1.3, 0.6  # of a flight; radians between its end and the next known rotation
TURNING = 0.02  # weight of that against the texture
NEUTRAL, UNKNOWN = 2.0, 30.0  # cost of unknown texture, and the points that it counts as
OUTSIDE = 1.5  # cost of a point outside the mask
CLEARLY = 0.8  # of its cost: another rotation has to be better by so much
LOOKS = 6  # frames of a grasp in which its rotation is looked for
REFINED, STEPS, RATE = 10, 30, 0.04  # the best of the grid, each moved to its own best place first
APART = 0.35  # radians between them


def grasps_by_texture(
    crops: Crops, surface: Surface, first: Aligned, start: Poses, pieces: Int[np.ndarray, " C"]
) -> Poses:
    """Poses of frames in grasps and rests: those of `first`, and of other pieces by texture.

    Each piece turns as the hands do (`start`), from a rotation that is found for all of it.
    """
    known = np.isin(crops.frames, first.frames)
    poses = _distances_of(crops, start, first, known)
    search = _Search(crops, surface, first, known)
    rotations = poses.rotations.clone()
    for piece in np.unique(pieces[~known]).tolist():
        rows = np.flatnonzero(~known & (pieces == piece))
        rotations[rows] = search.piece(rows, start.rotations[rows], poses.translations)
    return Poses(rotations, poses.translations)


def flights_by_texture(
    crops: Crops, surface: Surface, first: Aligned, start: Poses, fps: float
) -> Poses:
    """Poses of all frames: those of `first`, and between them a constant spin found by texture.

    Frames before the first known one and after the last keep its rotation.
    """
    known = np.isin(crops.frames, first.frames)
    poses = _distances_of(crops, start, first, known)
    search = _Search(crops, surface, first, known)
    rotations = poses.rotations.clone()
    for rows in _runs(np.flatnonzero(~known)):
        before, after = rows[0] - 1, rows[-1] + 1
        if before < 0:
            rotations[rows] = rotations[after].clone()
        elif after == len(known):
            rotations[rows] = rotations[before].clone()
        else:
            rotations[rows] = search.flight(rows, rotations, poses.translations, fps)
    return Poses(rotations, poses.translations)


def _distances_of(crops: Crops, start: Poses, first: Aligned, known: np.ndarray) -> Poses:
    """`first` where it is known; elsewhere `start`, farther by as much as `first` is."""
    rotations, translations = start.rotations.clone(), start.translations.clone()
    centers = crops.centers()
    before = (translations - centers)[known].norm(dim=-1)
    after = (first.poses.translations - centers[known]).norm(dim=-1)
    moved = centers + (translations - centers) * (after / before).median()
    translations[~known] = moved[~known]
    rotations[known], translations[known] = first.poses.rotations, first.poses.translations
    return Poses(rotations, translations)


class _Search:
    """Costs of rotations in frames, against the texture that an alignment has found."""

    def __init__(self, crops: Crops, surface: Surface, first: Aligned, known: np.ndarray) -> None:
        step = -(-len(surface.corners) // POINTS)
        self.points = surface.points(first.vertices)[::step]
        self.normals = surface.normals(first.vertices)[::step]
        features = crops.features(BLUR)
        features = features / features.std()
        self.maps = torch.cat((features, crops.masks, crops.hidden), 1)
        self.crops, self.grid = crops, _rotations(TRIED)
        part = crops.rows(np.flatnonzero(known))
        world = first.poses.place(self.points)
        values = part.sample(self.maps[known], part.project(world)[0])
        seen = self._facing(part.centers()[:, None] - world, first.poses.rotations)
        weight = (seen * values[..., 3])[..., None]
        self.known = weight.sum(0)[:, 0] > 1.5
        self.texture = (weight * values[..., :3]).sum(0) / weight.sum(0).clamp_min(1e-3)

    def _facing(self, toward: Tensor, rotations: Tensor) -> Tensor:
        toward = torch.nn.functional.normalize(toward, dim=-1)
        return (((self.normals @ rotations.mT) * toward).sum(-1) > SURE).float()

    def costs(self, row: int, rotations: Float[Tensor, "R 3 3"], place: Tensor) -> Tensor:
        """Of rotations in one frame; places are moved so that the points' middle is the mask's."""
        one = self.crops.rows(np.array([row]))
        world = self.points @ rotations.mT + place
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
        off = (values[..., :3] - self.texture).abs().sum(-1).clamp_max(4.0)
        weight = seen * mask * self.known
        # sides that no frame has shown yet say nothing for or against a rotation
        photo = (weight * off).sum(-1) + NEUTRAL * UNKNOWN
        photo = photo / (weight.sum(-1) + UNKNOWN)
        outside = ((1 - mask) * (1 - hidden)).mean(-1)
        return photo + OUTSIDE * outside

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

    def flight(
        self, rows: np.ndarray, rotations: Tensor, places: Tensor, fps: float
    ) -> Float[Tensor, "N 3 3"]:
        """Rotations between two known ones, by the constant spin whose pictures agree best.

        The spin about a world axis is tried for all turns up to `MOST_TURNS` that end within
        `SLACK` of the known rotation; the rest is spread over the flight.
        """
        frames = self.crops.frames
        first, last = rows[0] - 1, rows[-1] + 1
        ahead = rotations[last] @ rotations[first].mT
        spins = _ball(2 * np.pi * MOST_TURNS)
        rest = matrices_to_axis_angle(axis_angle_to_matrices(spins).mT @ ahead)
        kept = rest.norm(dim=-1) < SLACK
        spins, rest = spins[kept], rest[kept]
        seconds = (frames[last] - frames[first]) / fps
        total = TURNING * len(rows) * (spins.norm(dim=-1) / seconds / SPIN).square()
        parts = (frames[rows] - frames[first]) / (frames[last] - frames[first])
        tried = []
        for row, part in zip(rows.tolist(), parts.tolist(), strict=True):
            turn = axis_angle_to_matrices(part * spins) @ axis_angle_to_matrices(part * rest)
            tried.append(turn @ rotations[first])
            total = total + self.costs(row, tried[-1], places[row])
        return torch.stack([turns[total.argmin()] for turns in tried])


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


def _ball(radius: float, step: float = 0.45) -> Float[Tensor, "N 3"]:
    """Vectors of a grid within a ball, none first."""
    count = int(radius / step)
    line = torch.arange(-count, count + 1) * step
    grid = torch.cartesian_prod(line, line, line)
    grid = grid[grid.norm(dim=-1) <= radius]
    return grid[grid.norm(dim=-1).argsort()]


def _rotations(count: int) -> Float[Tensor, "R 3 3"]:
    """Rotations spread over all (super-Fibonacci spiral, Alexa 2022)."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    psi = 1.533751168755204288118041413
    a, b = 2 * torch.pi * s / 2**0.5, 2 * torch.pi * s / psi
    low, high = (s / count).sqrt(), (1 - s / count).sqrt()
    quats = torch.stack((low * a.sin(), low * a.cos(), high * b.sin(), high * b.cos()), -1)
    return quats_to_matrices(quats).float()


def _runs(rows: np.ndarray) -> list[np.ndarray]:
    """Stretches of numbers that follow each other."""
    return [r for r in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1) if len(r)]
