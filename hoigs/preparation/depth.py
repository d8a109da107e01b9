"""Depth of an estimator, brought to the clip's metres: against the scene's points, or the body."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from hoigs.core.interfaces.estimator import DepthKind, DepthMaps
from hoigs.core.values.camera import Camera
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError

ENOUGH = 40  # anchors for a frame's own scale; frames with fewer share the clip's
CELL = 6  # pixels: the body's nearest vertex of each cell is the one that is seen
BEHIND = 0.03  # metres that a seen vertex may lie behind it
FARTHEST = 200.0  # metres; farther is unknown
TRIES, SCORED = 100, 2000  # of the search for a start, and anchors that judge each
ROUNDS = 12  # of reweighting
SPREAD = 0.05  # relative error at which an anchor begins to count as an outlier
POOR = 0.1  # relative residual that deserves a warning


@dataclass(frozen=True)
class Anchors:
    """Pixels of one frame whose depth is known from elsewhere.

    Attributes:
        values: of the estimator, there. depth: metres.
    """

    values: Float[np.ndarray, " N"]
    depth: Float[np.ndarray, " N"]


@dataclass(frozen=True)
class DepthFit:
    """How an estimator's values become metres.

    Attributes:
        kind: "metric": depth = scale x value. "disparity": 1 / depth = scale x value + shift.
        scale, shift: of each frame.
        residual: median of |fitted - known| / known depth over the anchors of each frame; NaN
            without any.
        against: what the anchors were.
        provenance: for the clip and the report.
    """

    kind: DepthKind
    scale: Float[np.ndarray, " F"]
    shift: Float[np.ndarray, " F"]
    residual: Float[np.ndarray, " F"]
    against: str
    provenance: str

    @property
    def typical(self) -> float:
        """Median residual over the frames that have anchors."""
        return float(np.nanmedian(self.residual))

    def metres(self, values: Float[np.ndarray, "H W"], frame: int) -> Float[np.ndarray, "H W"]:
        """Depth of a map of one frame, metres; 0 where it is not known."""
        return to_metres(values, self.kind, self.scale[frame], self.shift[frame])


def to_metres(
    values: Float[np.ndarray, "*shape"], kind: DepthKind, scale: float, shift: float
) -> Float[np.ndarray, "*shape"]:
    """An estimator's values as metres; 0 where they are unknown, or not between 0 and 200 m."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = scale * values if kind == "metric" else 1 / (scale * values + shift)
        known = np.isfinite(depth) & (depth > 0) & (depth < FARTHEST)
    return np.where(known, depth, 0).astype(np.float32)


class DepthSource:
    """An estimator's maps on the clip's undistorted frames, read on access; NaN where unknown."""

    def __init__(self, maps: DepthMaps, video: Frames, undistort: Undistortion) -> None:
        self.kind, self.provenance = maps.kind, maps.provenance
        self._maps, self._video, self._undistort = maps.maps, video, undistort

    def __getitem__(self, position: int) -> Float[np.ndarray, "H W"]:
        values = self._maps[self._video.indices[position]].astype(np.float32)
        size = (self._video.width, self._video.height)
        if values.shape[::-1] != size:
            values = np.asarray(Image.fromarray(values).resize(size, Image.Resampling.NEAREST))
        unknown = ~np.isfinite(values) | ((values <= 0) if self.kind == "metric" else False)
        # outside the picture an undistorted map is 0, which a disparity may well be
        seen = self._undistort.mask(~unknown)
        values = self._undistort.depth(np.where(unknown, np.float32(0), values))
        return np.where(seen, values, np.float32(np.nan))


def fit_depth(
    source: DepthSource,
    scene: Callable[[int], Float[np.ndarray, "N 3"]],
    body: Callable[[int], Float[np.ndarray, "M 3"]],
    frames: int,
    progress: Callable[[float], None],
) -> DepthFit:
    """Scale, and shift of disparities, of every frame.

    A frame with enough points of the scene has its own; the others share one of the whole clip,
    found from all anchors. Without scene points (a static camera) the body's surface anchors it.

    Args:
        scene, body: x, y, depth of what is seen in a frame: points of the scene, of the body.

    Raises:
        SourceError: the maps and what is known have hardly a pixel in common.
    """
    rows = []
    for i in range(frames):
        values = source[i]
        rows.append([_anchors(values, known) for known in (scene(i), body(i))])
        progress((i + 1) / frames)
    use_scene = sum(len(row[0].values) for row in rows) >= ENOUGH
    anchors = [row[0] if use_scene else row[1] for row in rows]
    against = "points of the scene" if use_scene else "the fitted body's surface"
    everything = Anchors(*(np.concatenate([getattr(a, n) for a in anchors]) for n in _FIELDS))
    if len(everything.values) < ENOUGH:
        raise SourceError(
            f"estimators.depth: {len(everything.values)} pixels have both a depth and {against}; "
            "does the depth belong to this video, and is it known there?"
        )
    together = solve(everything, source.kind)
    own = [len(a.values) >= ENOUGH and use_scene for a in anchors]
    solved = [solve(a, source.kind) if o else together for a, o in zip(anchors, own, strict=True)]
    scale, shift = np.array(solved).T
    residual = np.array(
        [_residual(a, source.kind, *s) for a, s in zip(anchors, solved, strict=True)]
    )
    how = "a scale" if source.kind == "metric" else "a scale and a shift"
    text = (
        f"{source.provenance or 'given'}; {how} from {against}, "
        f"{sum(own)} of {frames} frames by themselves; typically "
        f"{100 * np.nanmedian(residual):.1f} % off"
    )
    return DepthFit(source.kind, scale, shift, residual, against, text)


_FIELDS = ("values", "depth")


def _anchors(values: Float[np.ndarray, "H W"], known: Float[np.ndarray, "N 3"]) -> Anchors:
    row, column = known[:, 1].astype(int), known[:, 0].astype(int)
    found = values[row, column]
    there = np.isfinite(found)
    return Anchors(found[there].astype(np.float64), known[there, 2].astype(np.float64))


def solve(anchors: Anchors, kind: DepthKind) -> tuple[float, float]:
    """Scale and shift whose relative errors are least: least median of squares (Rousseeuw 1984)
    from a few anchors at a time, then least squares with outliers weighted down (Cauchy).
    """
    values, depth = anchors.values, anchors.depth
    # both are linear: depth = s v, and 1 = depth (s v + b); errors relative to the depth
    terms = (values / depth,) if kind == "metric" else (values * depth, depth)
    columns = np.stack(terms, 1)
    solution = _least_median(columns)
    for _ in range(ROUNDS):
        miss = np.abs(columns @ solution - 1)
        root = 1 / np.hypot(1, miss / max(SPREAD, float(np.median(miss))))
        solution = np.linalg.lstsq(columns * root[:, None], root, rcond=None)[0]
    return float(solution[0]), float(solution[1]) if len(solution) > 1 else 0.0


def _least_median(columns: Float[np.ndarray, "N K"]) -> Float[np.ndarray, " K"]:
    """Of solutions of `columns @ x = 1` through random rows, the one with the least median miss."""
    dice = np.random.default_rng(0)
    unknowns = columns.shape[1]
    best, least = np.linalg.lstsq(columns, np.ones(len(columns)), rcond=None)[0], np.inf
    scored = columns[dice.permutation(len(columns))[:SCORED]]
    for _ in range(TRIES):
        rows = columns[dice.integers(0, len(columns), unknowns)]
        tried = np.linalg.lstsq(rows, np.ones(unknowns), rcond=None)[0]
        miss = float(np.median(np.abs(scored @ tried - 1)))
        if miss < least:
            best, least = tried, miss
    return best


def _residual(anchors: Anchors, kind: DepthKind, scale: float, shift: float) -> float:
    if not len(anchors.values):
        return float("nan")
    fitted = to_metres(anchors.values, kind, scale, shift)
    return float(np.median(np.abs(fitted - anchors.depth) / anchors.depth))


def seen_points(
    points: Float[Tensor, "P 3"], camera: Camera, hidden: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "N 3"]:
    """x, y, depth of world points in the picture whose pixel is not hidden."""
    xy, depth = camera.project(points)
    rows = camera.shows(xy, depth, near=0.05)
    found = torch.cat((xy, depth[:, None]), 1)[rows].numpy()
    return found[~hidden[found[:, 1].astype(int), found[:, 0].astype(int)]]


def seen_surface(
    vertices: Float[Tensor, "V 3"], camera: Camera, mask: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "N 3"]:
    """x, y, depth of a body's vertices that are nearest to the camera and on its mask."""
    found = seen_points(vertices, camera, ~mask)
    if not len(found):
        return found
    cell = (found[:, 1] // CELL).astype(int) * (camera.width // CELL + 1)
    cell += (found[:, 0] // CELL).astype(int)
    nearest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest, cell, found[:, 2])
    return found[found[:, 2] < nearest[cell] + BEHIND]


def median_depth(
    frames: Iterable[tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]],
    size: tuple[int, int],
) -> Float[np.ndarray, "h w"]:
    """Depth of a scene seen by a camera that stands still: the median over frames, metres.

    Args:
        frames: depth, metres, 0 unknown, and what moves. size: width, height of the result.

    Returns:
        0 where no frame shows the scene.
    """
    small = []
    for depth, mask in frames:
        seen = np.where(mask | (depth <= 0), np.float32(np.nan), depth)
        small.append(np.asarray(Image.fromarray(seen).resize(size, Image.Resampling.NEAREST)))
    stack = np.ma.masked_invalid(np.stack(small))
    return np.ma.median(stack, axis=0).filled(0).astype(np.float32)
