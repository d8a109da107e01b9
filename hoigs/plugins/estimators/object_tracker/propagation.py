"""Masks from frame to frame, outwards from a prompted one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.behind import Behind
from hoigs.plugins.estimators.object_tracker.footage import (
    Footage,
    Window,
    bins_of,
    histogram,
    to_features,
)
from hoigs.plugins.estimators.object_tracker.path import Evidence, Path, center_of, found_path
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, set_off, walked

# Labels of pixels from frames in which they are known: by similar patches nearby.

REACH, STRIDE, PATCH = 6, 2, 5  # cells that patches are searched in, their grid, their side


def transferred(
    colors: Float[np.ndarray, "n n 3"],
    known: list[tuple[Float[np.ndarray, "n n 3"], Float[np.ndarray, "n n"]]],
    softness: float = 12.0,
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """Probability of each pixel by the labels of similar patches, and how similar these are.

    Args:
        known: colours and soft mask of windows of the same size, centred on the object.
    """
    import torch
    from torch.nn import functional as F

    def tensor(a: np.ndarray) -> torch.Tensor:
        a = a[..., None] if a.ndim == 2 else a
        return torch.from_numpy(np.ascontiguousarray(a)).permute(2, 0, 1)[None]

    shifts = range(-REACH, REACH + 1, STRIDE)
    here = tensor(colors)
    n, m = colors.shape[:2]
    costs, labels = [], []
    for theirs, mask in known:
        padded = F.pad(tensor(theirs), [REACH] * 4, mode="replicate")
        soft = F.pad(tensor(mask), [REACH] * 4, mode="replicate")
        for dy in shifts:
            for dx in shifts:
                y, x = REACH + dy, REACH + dx
                away = (padded[..., y : y + n, x : x + m] - here).pow(2).sum(1)
                costs.append(away + 0.15 * (dy * dy + dx * dx))
                labels.append(soft[0, :, y : y + n, x : x + m])
    cost = torch.stack(costs, 1)
    for size in ((PATCH, 1), (1, PATCH)):  # a square's mean, one axis after the other
        half = tuple(side // 2 for side in size)
        cost = F.avg_pool2d(cost, size, 1, half, count_include_pad=False)
    cost = cost[0]
    label = torch.cat(labels)
    least = cost.min(0).values
    weight = torch.exp(-(cost - least) / softness)
    prior = (weight * label).sum(0) / weight.sum(0)
    return prior.numpy(), torch.exp(-least / 150).numpy()


def shift_of(
    colors: Float[np.ndarray, "N N 3"],
    template: Float[np.ndarray, "n n 3"],
    soft: Float[np.ndarray, "n n"],
    odds: Float[np.ndarray, "N N"],
    slack: float,
) -> tuple[float, float, float]:
    """Where the template's object lies in a larger window: shift x, y of the middle, and the error.

    The sum of squared differences over the mask, by correlation; `odds` of the pixels help where
    the object turns, and places off the middle cost a little.
    """
    from scipy.signal import fftconvolve

    weight = soft / max(soft.sum(), 1e-6)

    def correlate(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        return fftconvolve(image, kernel[::-1, ::-1], mode="valid")

    error = correlate((colors**2).sum(-1), weight) + float((weight[..., None] * template**2).sum())
    for c in range(3):
        error = error - 2 * correlate(colors[..., c], weight * template[..., c])
    error = np.maximum(error, 0) / 120
    error = np.minimum(error, 4) - 0.6 * correlate(np.tanh(odds), weight)
    rows, columns = error.shape
    y, x = np.mgrid[:rows, :columns]
    y, x = y - (rows - 1) / 2, x - (columns - 1) / 2
    error = error + 0.5 * (np.hypot(x, y) / slack) ** 2
    k = np.unravel_index(error.argmin(), error.shape)
    return float(x[k]), float(y[k]), float(error[k])


BY_COLOR, BY_LOOKS = 0.6, 0.2  # weights of their log-odds
AGAIN, AHEAD = 6, 14  # frames after which the path is found anew, and how far
NEAR = 0.4  # of the object's breadth: an arm before it may part it by so much
BEYOND = 0.3  # probability below which a pixel is none of the object's
SURE = 0.35  # confidence below which the object counts as not seen


@dataclass(frozen=True)
class Track:
    """The result: soft masks as uint8 at the footage's size, and how sure each is."""

    soft: UInt8[np.ndarray, "F h w"]
    confidence: Float[np.ndarray, "F"]


@dataclass(frozen=True)
class Sighting:
    """The object in one frame, cut out by a window."""

    window: Window
    colors: Float[np.ndarray, "n n 3"]
    soft: Float[np.ndarray, "n n"]


class Propagation:
    """Masks from frame to frame, away from a prompted one."""

    def __init__(
        self,
        evidence: Evidence,
        path: Path,
        start: PromptedMask,
        unchanged: float,
        moving: bool,
        behind: Behind | None = None,
    ) -> None:
        self.footage, self.scene, self.colors = evidence.footage, evidence.scene, evidence.colors
        self.evidence, self.path = evidence, path
        self.behind = behind
        self.unchanged = unchanged  # log-odds by which a pixel that shows the scene is not ours
        window = window_of(start.soft > 0.5)
        self.first = self._sighting(start.frame, window, window.cut(start.soft))
        self.last = self.first
        self.center = np.array(window.center)  # of the last window
        self.off = self.center - path.centers[start.frame]  # of windows from the path
        self.velocity = np.zeros(2)
        self.unseen = 0
        self.moving = moving  # the camera, so that the path is found anew on the way
        self.seen, self.steps = (start.frame, start.soft > 0.5), 0
        self.area = float(self.seen[1].sum())

    def _sighting(self, i: int, window: Window, soft: np.ndarray) -> Sighting:
        return Sighting(window, self._colors(i, window), soft)

    def step(self, i: int) -> tuple[float, np.ndarray]:
        """Confidence and soft mask (uint8) of frame `i`, next to the one before."""
        nothing = np.zeros(self.footage.shape, np.uint8)
        if self.moving and not self.unseen and self.steps % AGAIN == 0:
            self._look_ahead(i)
        self.steps += 1
        if not self.path.seen[i]:
            self.unseen += 1
            return 0.0, nothing
        away = None if self.scene is None else self.scene.difference(i)
        window = self._aligned(i, away)
        soft, prior = self._segmented(i, window, away)
        mask = self._kept(soft > 0.5, prior, window.step)
        soft = np.where(ndimage.binary_dilation(mask, iterations=2), soft, 0)
        confidence = self._confidence(mask, soft, self._colors(i, window))
        if confidence < SURE:
            self.unseen += 1
            return confidence, nothing
        pasted = window.paste(soft, self.footage.shape)
        self._remember(i, pasted, window, confidence)
        return confidence, pasted

    def _look_ahead(self, i: int) -> None:
        """Finds the path of the next frames anew, by what the object looks like by now."""
        last, mask = self.seen
        step = 1 if i > last else -1
        ahead = range(last, last + step * (AHEAD + 1), step)
        frames = [k for k in ahead if 0 <= k < len(self.footage)]
        found = found_path(replace(self.evidence, colors=self.colors), {last: mask}, frames)
        centers, seen = self.path.centers.copy(), self.path.seen.copy()
        centers[frames], seen[frames] = found.centers, found.seen
        self.path = Path(centers, seen)

    def _colors(self, i: int, window: Window) -> np.ndarray:
        return to_features(window.cut(self.footage.lab[i]))

    def _aligned(self, i: int, away: np.ndarray | None) -> Window:
        """The last sighting's window moved to where it fits best near the path."""
        last, step = self.last, self.last.window.step
        reach = self.path.centers[i] + self.off
        guesses = [reach] if self.unseen else [reach, self.center + self.velocity]
        slack = max(4, int(0.22 * last.window.n))
        n = last.window.n + 2 * slack
        best = None
        for x, y in guesses:
            wide = Window(round(x - n * step / 2), round(y - n * step / 2), n, step)
            colors = self._colors(i, wide)
            odds = self._odds(i, wide, colors, away)
            odds = np.where(wide.inside(self.footage.shape), odds, -3)
            dx, dy, error = shift_of(colors, last.colors, last.soft, odds, slack)
            place = np.array(wide.center) + np.array((dx, dy)) * step
            # a place far from the path is unlikely
            error += 0.5 * (np.hypot(*(place - reach)) / (last.window.n * step / 2)) ** 2
            if best is None or error < best[0]:
                best = (error, place)
        assert best is not None
        return last.window.at(*best[1])

    def _segmented(
        self, i: int, window: Window, away: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Soft mask, and what other frames alone say of it."""
        colors = self._colors(i, window)
        known = [(self.last.colors, self.last.soft)]
        if self.first is not self.last and self.first.window.n == window.n:
            known.append((self.first.colors, self.first.soft))
        prior, similar = transferred(colors, known)
        valid = window.inside(self.footage.shape)
        near = histogram(bins_of(colors), (prior < 0.3) * valid * 1.0)
        shape = np.log((prior + 0.03) / (1.03 - prior)) * (0.4 + 0.6 * similar)
        odds = self._odds(i, window, colors, away, near, prior)
        if self.behind is not None:
            outside = (prior < 0.3) & valid
            better = self.behind.odds(i, window, colors, self.colors.inside, outside)
            odds = np.where(np.isnan(better), odds, better)
        odds = shape + odds
        odds = np.where(valid, odds, -9)
        return walked(odds, colors), prior

    def _odds(
        self,
        i: int,
        window: Window,
        colors: np.ndarray,
        away: np.ndarray | None,
        near: np.ndarray | None = None,
        prior: np.ndarray | None = None,
    ) -> np.ndarray:
        """Log-odds of a window's pixels by colour, person's mask and scene.

        near: colours around the object in this frame. prior: where other frames put it.
        """
        odds = BY_COLOR * self.colors.odds(bins_of(colors), near)
        odds += BY_LOOKS * window.cut(self.evidence.looks.odds(i))
        person = window.cut(self.footage.body(i))
        # a person's mask that takes in most of what is known to be the object says little
        taken = 0.5 if prior is None else float((prior * person).sum() / max(prior.sum(), 1e-6))
        odds -= 2.0 * max(0.0, 1 - 1.3 * taken) * person
        if away is not None:
            changed = np.nan_to_num(1.2 * np.tanh((away - 4) / 3), nan=0.0)
            odds += window.cut(np.maximum(changed, -self.unchanged))
        return odds

    def _kept(self, mask: np.ndarray, prior: np.ndarray, step: int) -> np.ndarray:
        """The part of a mask that the labels of other frames support, holes filled.

        Where it is larger than the object was, what hangs on by a narrow bridge is cut off.
        """
        kept = _supported(mask, prior)
        for width in (1, 2, 3, 4, 6):
            if kept.sum() * step**2 < 1.2 * self.area:
                break
            core = ndimage.binary_erosion(kept, iterations=width)
            part = ndimage.binary_dilation(_supported(core, prior), iterations=width) & kept
            if part.sum() * step**2 < 0.6 * self.area:
                break
            kept = part
        filled = ndimage.binary_fill_holes(kept)
        holes, _ = ndimage.label(filled & ~kept)
        big = np.bincount(holes.ravel()) > 0.03 * kept.sum()
        big[0] = True
        return kept | ((holes > 0) & ~big[holes])

    def _confidence(self, mask: np.ndarray, soft: np.ndarray, colors: np.ndarray) -> float:
        """By colours like the object's, decided pixels, and a size like that before."""
        if mask.sum() < 6:
            return 0.0
        seen = histogram(bins_of(colors), mask * 1.0)
        decided = float(np.abs(2 * soft[mask] - 1).mean()) ** 0.5
        area = float(mask.sum()) * self.last.window.step**2
        ratio = min(area, self.area) / max(area, self.area)
        return self.colors.likeness(seen) ** 0.5 * decided * min(1.0, 2.0 * ratio**0.5)

    def _remember(self, i: int, pasted: np.ndarray, window: Window, confidence: float) -> None:
        mask = pasted > 127
        self.seen = (i, mask)
        fresh = window_of(mask) if mask.any() else window
        # the size changes slowly, so that windows of neighbouring frames can be compared
        if not 0.8 < fresh.n * fresh.step / (window.n * window.step) < 1.25:
            window = fresh
        else:
            window = window.at(*center_of(mask)) if mask.any() else window
        center = np.array(window.center)
        self.velocity = center - self.center if self.unseen == 0 else np.zeros(2)
        self.center, self.unseen = center, 0
        self.off = 0.7 * self.off + 0.3 * (center - self.path.centers[i])
        self.last = self._sighting(i, window, window.cut(pasted.astype(np.float32) / 255))
        self.area = 0.9 * self.area + 0.1 * float(mask.sum())
        # it turns, and other sides of it have other colours
        if confidence > (0.6 if self.moving else 0.75):
            valid = self.last.window.inside(self.footage.shape)
            seen = own_colors(bins_of(self.last.colors), self.last.soft, valid, self.colors.inside)
            self.colors = self.colors.blended(seen, 0.12 if self.moving else 0.04)


def own_colors(
    bins: Int[np.ndarray, "h w"],
    soft: Float[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    known: Float[np.ndarray, "B"],
) -> Float[np.ndarray, "B"]:
    """Colours inside a mask; those that more pixels around it have only as far as they were known.
    A hand comes from beyond the object, of which a new side has colours that are seldom around."""
    inside, beyond = soft > 0.5, (soft < BEYOND) & valid
    seen, around = (histogram(bins, m * 1.0) for m in (inside, beyond))
    own = seen * inside.sum() > around * beyond.sum()
    return np.where(own, seen, np.minimum(seen, known))


def _supported(mask: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """The part of a mask with most support, and others nearby whose own is strong."""
    labels, count = ndimage.label(mask)
    if count < 2:
        return mask
    rows = np.arange(1, count + 1)
    sums, means = (f(prior, labels, rows) for f in (ndimage.sum_labels, ndimage.mean))
    largest = labels == 1 + sums.argmax()
    gaps = ndimage.minimum(ndimage.distance_transform_edt(~largest), labels, rows)
    near = gaps < NEAR * np.sqrt(largest.sum())
    kept = (sums == sums.max()) | ((sums > 0.1 * sums.max()) & (means > 0.7) & near)
    return np.isin(labels, rows[kept])


def window_of(mask: Bool[np.ndarray, "h w"]) -> Window:
    """A window with room about a mask."""
    y, x = np.nonzero(mask)
    half = 0.5 * max(np.ptp(x), np.ptp(y)) + 1
    return Window.around((x.min() + x.max() + 1) / 2, (y.min() + y.max() + 1) / 2, 1.5 * half + 8)


def contrast(footage: Footage, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
    """How well a mask of one frame is set off (`prompts.set_off`), 0 to 1."""
    window = window_of(mask)
    colors, valid = window.cut(footage.colors(i)), window.inside(footage.shape)
    return set_off(window.cut(mask) > 0.5, colors, bins_of(colors), valid)
