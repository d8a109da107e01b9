"""Where nothing was clicked: what people handle, by all that speaks for it, in a few frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.core.interfaces.estimator import FramePrompt, PromptPoint
from hoigs.plugins.estimators.object_tracker.footage import ColorModel, Footage, bins_of, histogram
from hoigs.plugins.estimators.object_tracker.likeness import Likeness
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, prompted_mask
from hoigs.plugins.estimators.object_tracker.scene import Scene, carried

SAMPLES = 24  # frames that are searched
SHOWN, OTHERWISE = 0.3, 0.5  # visibility of a landmark; share of the frames that show everybody
AREA = (0.0003, 0.12)  # of the image, least and largest
PARTS = 6  # of a frame that are looked at
OFTEN = 0.1  # mean over frames of likeness times score from which something is there again
AROUND, ALIKE = 4, 0.7  # samples before and after in which a thing of these colours is looked for
TOUCHED = 0.97  # nearness of what a hand may touch
TRIED = 12  # frames in which masks are grown
GOOD, SAME = 0.5, 0.55  # of the best mask: least value, least likeness of colours
APART = 8  # masks are at least this part of the video from each other


@dataclass(frozen=True)
class Candidate:
    """A part of one frame that may be the thing.

    Attributes:
        point: its innermost pixel, x and y. score: what speaks for it in this frame, 0 to 1.
        colors: their histogram. radius: that of a disc of its area. near: how near a hand is, 0..1.
    """

    frame: int
    point: tuple[float, float]
    score: float
    colors: Float[np.ndarray, "B"]
    radius: float
    near: float

    def alike(self, other: Candidate) -> float:
        return float(np.sqrt(self.colors * other.colors).sum())


@dataclass(frozen=True)
class Proposal:
    """A mask in one frame, and the click that it was grown from, in pixels of the video."""

    mask: PromptedMask
    prompt: FramePrompt


def proposed(
    footage: Footage,
    scene: Scene,
    people: Sequence[Float[np.ndarray, "F 33 4"]] = (),
    taken: Bool[np.ndarray, "F h w"] | None = None,
) -> list[Proposal]:
    """The object in a few frames across the video, the best first; empty where there is none.

    Args:
        people: landmarks of each in the footage. taken: pixels of other objects.
    """
    frames = sampled(len(footage), people)
    likeness = Likeness.of(footage, scene, people, frames)
    found: list[Candidate] = []
    for i in frames:
        odds = likeness.odds(i)
        if taken is not None:
            odds[ndimage.binary_dilation(taken[i], iterations=2 * footage.unit)] = -9
        found += _parts(footage, i, odds, likeness.nearness(i))
    order = ranked(without_scenery(found, scene, 0.02 * footage.diagonal), len(frames))
    if not order:
        return []
    first = {c.frame: c for c in reversed(order)}  # the best of each frame
    tried = [c for c in order if first[c.frame] is c][:TRIED]
    known = _colors_of(footage, found, order[0], frames)
    grown = [_grown(likeness, c, known) for c in tried]
    return _spread(footage, grown)


def sampled(count: int, people: Sequence[Float[np.ndarray, "F 33 4"]]) -> list[int]:
    """The frames that are searched."""
    frames = with_everybody(count, people)
    return [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, SAMPLES).astype(int))]


def with_everybody(count: int, people: Sequence[Float[np.ndarray, "F 33 4"]]) -> list[int]:
    """The frames in which nobody is lost, who would be taken for a thing there; all, if half of
    them or fewer are such."""
    shown = np.ones(count, bool)
    for person in people:
        shown &= (np.nan_to_num(person[..., 3]) > SHOWN).any(1)
    return np.flatnonzero(shown if shown.mean() > OTHERWISE else np.ones(count, bool)).tolist()


def _parts(
    footage: Footage, i: int, odds: Float[np.ndarray, "h w"], near: Float[np.ndarray, "h w"]
) -> list[Candidate]:
    """The largest connected parts of one frame that look like a thing."""
    region = ndimage.gaussian_filter(odds, footage.unit) > 0.5
    region = ndimage.binary_opening(region, iterations=footage.unit)
    region = ndimage.binary_closing(region, iterations=footage.unit)
    labels, _ = ndimage.label(region)
    bins = bins_of(footage.colors(i))
    sizes = np.bincount(labels.ravel())[1:]
    found = []
    for k in np.argsort(-sizes)[:PARTS]:
        area = sizes[k] / region.size
        if not AREA[0] <= area <= AREA[1]:
            continue
        part = ndimage.binary_fill_holes(labels == k + 1)
        depth = ndimage.distance_transform_edt(np.pad(part, 1))[1:-1, 1:-1]
        y, x = np.unravel_index(depth.argmax(), depth.shape)
        round_ = float(np.pi * depth.max() ** 2 / part.sum())  # 1 for a disc
        score = float(near[part].max() * np.tanh(odds[part].mean().clip(0)))
        score *= min(1.0, 1.6 * round_**0.5) * min(1.0, (area / 0.002) ** 0.5)
        point = (float(x) + 0.5, float(y) + 0.5)
        colors, radius = histogram(bins, part * 1.0), float(np.sqrt(part.sum() / np.pi))
        found.append(Candidate(i, point, score, colors, radius, float(near[part].max())))
    return found


def without_scenery(found: Sequence[Candidate], scene: Scene, slack: float) -> list[Candidate]:
    """Less for what no hand touches and what stays where it is in the scene: its edges, before a
    camera that moves."""
    frames = sorted({c.frame for c in found})
    by_frame = {i: [c for c in found if c.frame == i] for i in frames}

    def stays(c: Candidate) -> float:
        row = frames.index(c.frame)
        around = [i for i in frames[max(0, row - AROUND) : row + AROUND + 1] if i != c.frame]
        there = []
        for i in around:
            x, y = carried(scene, np.array(c.point), c.frame, i)
            there.append(
                any(
                    np.hypot(o.point[0] - x, o.point[1] - y) < c.radius + slack
                    and c.alike(o) > ALIKE
                    for o in by_frame[i]
                )
            )
        return float(np.mean(there)) if there else 0.0

    return [c if c.near > TOUCHED else replace(c, score=c.score * (1 - stays(c))) for c in found]


def ranked(found: Sequence[Candidate], frames: int) -> list[Candidate]:
    """Those of things that are seen in many of the frames in the same colours, the best first."""
    if not found:
        return []
    roots = np.sqrt(np.stack([c.colors for c in found]))
    likeness = (roots @ roots.T).clip(0, 1) ** 2
    scores = np.array([c.score for c in found])
    seen_in = np.array([c.frame for c in found])
    support = np.zeros(len(found))
    for i in np.unique(seen_in):
        rows = seen_in == i
        support += (likeness[:, rows] * scores[rows]).max(1)
    order = np.argsort(-support * np.sqrt(scores))
    return [found[k] for k in order if support[k] > OFTEN * frames]


def _colors_of(
    footage: Footage, found: Sequence[Candidate], best: Candidate, frames: Sequence[int]
) -> ColorModel:
    """Colours of the best candidate and of those like it, and of the whole frames."""
    inside = np.sum([c.score * best.alike(c) ** 2 * c.colors for c in found], axis=0)
    small = [bins_of(footage.colors(i)[::3, ::3]) for i in frames]
    return ColorModel(inside / inside.sum(), histogram(np.stack(small), np.ones_like(small) * 1.0))


def _grown(
    likeness: Likeness, c: Candidate, known: ColorModel
) -> tuple[float, Proposal, Float[np.ndarray, "B"]]:
    """The mask about a candidate, how good it is, and its colours.

    It is good where it is well set off, takes in all that looks like a thing around the hands, and
    consists of that.
    """
    footage = likeness.footage
    x, y = (round(v / footage.scale) for v in c.point)
    prompt = FramePrompt(footage.numbers[c.frame], (PromptPoint(x, y),))
    found = prompted_mask(footage, likeness.scene, c.frame, prompt, known)
    mask = found.soft > 0.5
    colors = histogram(bins_of(footage.colors(c.frame)), mask * 1.0)
    if not mask.any():
        return 0.0, Proposal(found, prompt), colors
    odds = ndimage.gaussian_filter(likeness.odds(c.frame), footage.unit).clip(-2, 2)
    near = likeness.nearness(c.frame)
    speaks = odds.clip(0) * near
    takes_in = speaks[mask].sum() / max(float(speaks[mask | (near > 0.5)].sum()), 1e-6)
    consists = 1 / (1 + np.exp(-3 * odds[mask].mean()))
    rows, columns = np.nonzero(mask)
    box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    drawn = tuple(round(float(v) / footage.scale) for v in box)
    prompt = FramePrompt(prompt.frame, prompt.points, drawn)  # type: ignore[arg-type]
    return float(found.quality * takes_in * consists), Proposal(found, prompt), colors


def _spread(
    footage: Footage, grown: Sequence[tuple[float, Proposal, Float[np.ndarray, "B"]]]
) -> list[Proposal]:
    """The best, and further ones that are nearly as good, look like it, and lie apart in time: a
    thing that turns or is hidden is then known on both sides."""
    ordered = sorted(grown, key=lambda g: -g[0])
    value, best, colors = ordered[0]
    if value <= 0:
        return []
    kept = [best]
    for other, proposal, theirs in ordered[1:]:
        gaps = [abs(proposal.mask.frame - p.mask.frame) for p in kept]
        alike = float(np.sqrt(colors * theirs).sum())
        if other > GOOD * value and alike > SAME and min(gaps) >= len(footage) / APART:
            kept.append(proposal)
    return kept
