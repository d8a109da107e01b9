"""Rotations of frames that hands say nothing of: a search over all rotations, by texture.

In flight an object may turn by more than half a turn, about any axis, and come down on another
side. Where a part of the clip has given its shape and texture, every rotation is compared with each
frame; the path through the frames that looks best and turns least is taken (Viterbi 1967).
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.preparation.objects.alignment import FACING, Aligned, Poses, Surface
from hoigs.preparation.objects.crops import Crops
from hoigs.preparation.objects.hands import HandMotion

TRIED = 1500  # rotations, about 22 degrees apart
POINTS = 300
BLUR = 3.0
SPIN = 9.0  # radians a second in flight that cost one unit
TURNING = 0.05  # weight of that against the texture
NEUTRAL, UNKNOWN = 2.0, 30.0  # cost of unknown texture, and the points that it counts as
OUTSIDE = 8.0  # cost of a point outside the mask
LOOKS = 6  # frames of a grasp in which its rotation is looked for


def placed_by_texture(
    crops: Crops, surface: Surface, first: Aligned, start: Poses, hands: HandMotion, fps: float
) -> Poses:
    """Poses of all frames: those of `first` in its frames, and found by texture in the others.

    A grasp or rest that no frame of `first` belongs to turns as the hands do, from a rotation that
    is found for all of it at once; frames of flight are found one by one.

    Args:
        first: alignment of the frames of one piece. start: rough poses of all.
    """
    known = np.isin(crops.frames, first.frames)
    search = _Search(crops, surface, first, known)
    rotations, translations = start.rotations.clone(), start.translations.clone()
    rotations[known], translations[known] = first.poses.rotations, first.poses.translations
    # what the first alignment changed of distances holds for the others too
    before = (start.translations - crops.centers())[known].norm(dim=-1)
    after = (first.poses.translations - crops.centers()[known]).norm(dim=-1)
    centers = crops.centers()
    farther = float((after / before).median())
    translations[~known] = (centers + (translations - centers) * farther)[~known]
    tied, pieces = ~hands.free[crops.frames], hands.pieces[crops.frames]
    for piece in np.unique(pieces[tied & ~known]).tolist():
        rows = np.flatnonzero(tied & ~known & (pieces == piece))
        rotations[rows] = search.piece(rows, start.rotations[rows], translations)
        known[rows] = True
    for rows in _runs(np.flatnonzero(~known)):
        rotations[rows] = search.flight(rows, rotations, translations, known, fps)
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
        self.known = weight.sum(0)[:, 0] > 0.5
        self.texture = (weight * values[..., :3]).sum(0) / weight.sum(0).clamp_min(1e-3)

    def _facing(self, toward: Tensor, rotations: Tensor) -> Tensor:
        toward = torch.nn.functional.normalize(toward, dim=-1)
        return (((self.normals @ rotations.mT) * toward).sum(-1) > FACING).float()

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
        total = torch.zeros(len(self.grid))
        for row in looks.tolist():
            turn = turns[int(np.flatnonzero(rows == row)[0])] @ turns[0].mT
            total += self.costs(row, turn @ self.grid, places[row])
        return turns @ turns[0].mT @ self.grid[total.argmin()]

    def flight(
        self, rows: np.ndarray, rotations: Tensor, places: Tensor, known: np.ndarray, fps: float
    ) -> Tensor:
        """Rotations of frames in flight; the frames before and after are kept where known."""
        frames = self.crops.frames
        ends = [
            row if 0 <= row < len(frames) and known[row] else None
            for row in (rows[0] - 1, rows[-1] + 1)
        ]
        table = []
        path = [row for row in (ends[0], *rows.tolist(), ends[1]) if row is not None]
        states = [rotations[row][None] if row in ends else self.grid for row in path]
        total = torch.zeros(len(states[0]))
        for at, row in enumerate(path):
            if at:
                gap = (frames[row] - frames[path[at - 1]]) / fps
                turned = _angles(states[at - 1], states[at])
                cost = total[:, None] + TURNING * (turned / gap / SPIN).square()
                total, back = cost.min(0)
                table.append(back)
            if row not in ends:
                total = total + self.costs(row, states[at], places[row])
        choice = [int(total.argmin())]
        for back in reversed(table):
            choice.append(int(back[choice[-1]]))
        chosen = {row: s[c] for row, s, c in zip(path, states, reversed(choice), strict=True)}
        return torch.stack([chosen[row] for row in rows.tolist()])


def _rotations(count: int) -> Float[Tensor, "R 3 3"]:
    """Rotations spread over all (super-Fibonacci spiral, Alexa 2022)."""
    from hoigs.core.maths.rotations import quats_to_matrices

    s = torch.arange(count, dtype=torch.float64) + 0.5
    psi = 1.533751168755204288118041413
    a, b = 2 * torch.pi * s / 2**0.5, 2 * torch.pi * s / psi
    low, high = (s / count).sqrt(), (1 - s / count).sqrt()
    quats = torch.stack((low * a.sin(), low * a.cos(), high * b.sin(), high * b.cos()), -1)
    return quats_to_matrices(quats).float()


def _angles(one: Float[Tensor, "A 3 3"], two: Float[Tensor, "B 3 3"]) -> Float[Tensor, "A B"]:
    """Radians between all pairs."""
    cosine = (one.flatten(1) @ two.flatten(1).mT - 1) / 2
    return torch.acos(cosine.clamp(-1, 1))


def _runs(rows: np.ndarray) -> list[np.ndarray]:
    """Stretches of numbers that follow each other."""
    return [r for r in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1) if len(r)]
