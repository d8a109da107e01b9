"""The object's mask in a frame that has clicks, scribbles or a box."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg

from hoigs.core.interfaces.estimator import FramePrompt
from hoigs.plugins.estimators.object_tracker.footage import (
    ColorModel,
    Footage,
    Window,
    bins_of,
    histogram,
    odds_of,
)
from hoigs.plugins.estimators.object_tracker.motion import Motion
from hoigs.plugins.estimators.object_tracker.scene import (
    Scene,
    StaticScene,
    median_of,
    scene_without,
)

# A soft mask that follows edges: a random walker with priors.


def walked(
    odds: Float[np.ndarray, "n n"],
    colors: Float[np.ndarray, "n n 3"],
    pull: float = 0.06,
    sharpness: float = 1.0,
) -> Float[np.ndarray, "n n"]:
    """Probability of each pixel to be inside (Grady 2005, multilabel random walks with priors).

    It minimises the sum over neighbours of w (p_i - p_j)^2 and over pixels of pull (p_i - q_i)^2,
    where q is the probability that `odds` gives, and w falls with the difference of colour.
    """
    smooth = ndimage.gaussian_filter(colors, (0.6, 0.6, 0))
    across = ((smooth[:, 1:] - smooth[:, :-1]) ** 2).sum(-1)
    down = ((smooth[1:] - smooth[:-1]) ** 2).sum(-1)
    # the scale of differences comes from the window itself
    unit = 2.0 * (across.mean() + down.mean()) / 2 + 2.0
    across, down = np.exp(-sharpness * across / unit * 2), np.exp(-sharpness * down / unit * 2)
    across, down = across + 1e-3, down + 1e-3
    n, m = odds.shape
    index = np.arange(n * m).reshape(n, m)
    i = np.concatenate((index[:, :-1].ravel(), index[:-1].ravel()))
    j = np.concatenate((index[:, 1:].ravel(), index[1:].ravel()))
    w = np.concatenate((across.ravel(), down.ravel()))
    links = sparse.coo_matrix((w, (i, j)), shape=(n * m, n * m)).tocsr()
    links = links + links.T
    total = np.asarray(links.sum(1)).ravel() + pull
    system = sparse.diags(total) - links
    prior = 1 / (1 + np.exp(-odds.astype(float).ravel()))
    jacobi = sparse.diags(1 / total)
    solved, _ = cg(system, pull * prior, x0=prior, rtol=1e-3, maxiter=60, M=jacobi)
    return solved.reshape(n, m).clip(0, 1).astype(np.float32)


RADII = (0.012, 0.022, 0.04, 0.065, 0.1, 0.16)  # of the object, in diagonals of the image
TINY = (0.0065,)  # tried where what grew to the others is a person
ROUNDS = 4
AGAIN, ROOM = 2, 1.7  # growths about the middle of the last, in an ellipse of its area times this
GROWN = 0.97  # intersection over union with the growth before, from which it grows no more
USUAL, LARGEST = 0.25, 0.55  # of the person's mask: what a held thing may, and cannot, cover of it
AT_PERSON = 0.2  # share of a click on a person, from which the object may lie on them, too
ON_PERSON = 0.6  # share of a mask on people, from which it lies on them
OF_PERSON, HELD = 0.75, 0.5  # share of the person's colours, and that no limb reaches: see below
COMMON = 2.0  # times that a colour may be more frequent on a person than along their limbs
UNEXPLAINED = (4.0, 7.0, 12.0)  # units of noise by which pixels differ from the scene
SCENE = 4.0  # units of noise up to which they look as the scene does
BESIDE = 0.1  # of a mask on a person: what looks like the scene beside them counts from there on
MOVING = np.array((0.3, 0.5))  # most that one frame says: a part of what turns is set off, too
STILL = 0.01  # of what one frame says: up to there nothing moves
# of `Judge.features`: the last by 143 clicks anywhere, the others by 83
WEIGHTS = (0.8, 1.2, -3.0, 2.3, 0.7, 2.3, 0.18, 3.0)
AS_GOOD = 0.25  # logarithms below the best up to which another mask is nearly as good
SET_OFF = 0.65  # quality below which a mask may be a patch of what is around it
POOR = 0.02  # quality below which masks are equally bad
INSIDE = (0.6, 1.5, 3.0)  # log-odds of the inside of a box, tried in turn


@dataclass(frozen=True)
class PromptedMask:
    """A mask at one frame.

    Attributes:
        soft: probability of each pixel of the frame. quality: how well it is set off, 0 to 1.
        on_person: the click lies on the person's mask, or at its edge.
        barred: pixels that the prompt rules out.
    """

    frame: int
    soft: Float[np.ndarray, "h w"]
    quality: float
    on_person: bool
    barred: Bool[np.ndarray, "h w"]


def prompted_mask(
    footage: Footage, scene: Scene, i: int, prompt: FramePrompt, known: ColorModel | None = None
) -> PromptedMask:
    """The best of masks grown from the prompt at several sizes, by colours and edges, and by what
    the scene leaves unexplained."""
    inside, outside, box = scaled(prompt, footage)
    center = inside.mean(0) if box is None else (box[:2] + box[2:]) / 2
    if not len(inside):
        inside = center[None]
    seed = _disc(footage.shape, inside, max(1.5, 0.005 * footage.diagonal))
    away = scene.difference(i)
    shown = seed if box is None else _filled(footage.shape, box)
    least = AT_PERSON if box is None else 0.5
    on_person = bool(footage.person[i][shown].mean() > least) if shown.any() else False
    at_rest = not median_of(away[seed]) > SCENE
    if at_rest and isinstance(scene, StaticScene):
        bare = scene_without(scene, i, seed)
        if bare is not None and median_of((changed := bare.difference(i))[seed]) > SCENE:
            away, at_rest = changed, False  # frames without it show its outline
    fixed = _evidence(footage.body(i), away, on_person, at_rest, box is not None)
    barred = footage.blank[i] | _disc(footage.shape, outside, max(1.5, 0.008 * footage.diagonal))
    fixed[barred] = -9
    fixed[seed] = 6
    if box is not None:
        barred = barred | ~shown
    growth = _Growth(footage, i, fixed, center, inside, known, box, footage.colors(i))
    judge = Judge(footage, i, away, on_person, box, Motion.of(footage, i))
    none = PromptedMask(i, np.zeros(footage.shape, np.float32), 0.0, on_person, barred)

    def best(tried: list[Tried], other: bool = False) -> PromptedMask:
        """other: of those that are nearly as good, the best that does not look like a person."""
        if not tried:
            return none
        scores, quality = judge.scores(tried), judge.quality(tried)
        found = [replace(none, soft=t.soft, quality=q) for t, q in zip(tried, quality, strict=True)]
        for k in (-scores).argsort():
            if not other or not looks_like_person(footage, found[k]):
                return found[k] if scores[k] > scores.max() - AS_GOOD else none
        return none

    tried = growth.masks()
    if box is None and not at_rest and not on_person:
        tried += growth.unexplained(away)
    found = best(tried)
    if box is None and found.quality > 0 and looks_like_person(footage, found):
        other, tiny = best(tried, other=True), best(growth.masks(TINY))
        if other.quality > 0:
            return other
        if tiny.quality > SET_OFF and not looks_like_person(footage, tiny):
            return tiny
    return found


@dataclass(frozen=True, eq=False)
class Tried:
    """A mask of a frame that may be the object's.

    Attributes:
        set_off: of `set_off`. spread: size at which it was grown, pixels. steady: how little it
            changes at the next size.
    """

    soft: Float[np.ndarray, "h w"]
    set_off: float
    spread: float
    steady: float = 1.0


def _steadied(family: list[Tried]) -> list[Tried]:
    """Masks that were grown at neighbouring sizes."""
    masks = [t.soft > 0.5 for t in family]
    near = [[j for j in (k - 1, k + 1) if 0 <= j < len(masks)] for k in range(len(masks))]
    return [
        replace(t, steady=max((overlap(masks[k], masks[j]) for j in near[k]), default=1.0))
        for k, t in enumerate(family)
    ]


@dataclass(frozen=True)
class Judge:
    """How good a mask of one frame is."""

    footage: Footage
    i: int
    away: Float[np.ndarray, "h w"]
    on_person: bool
    box: np.ndarray | None
    motion: Motion

    def quality(self, tried: list[Tried]) -> list[float]:
        """How well each is set off, 0 to about 1."""
        masks = [t.soft > 0.5 for t in tried]
        new = np.ones(len(masks))
        if not self.on_person:
            new = _novelty(masks, self.away, self.footage.diagonal)
        found = []
        for t, mask, share in zip(tried, masks, new):
            score = t.set_off * t.spread**0.1 * (0.4 + 0.6 * t.steady) * float(share)
            score *= _plausible(self.footage, self.i, mask, self.on_person)
            if self.box is not None:  # which is drawn so that the object reaches its sides
                score *= _reaching(mask, self.box) ** 2
            found.append(score)
        return found

    def scores(self, tried: list[Tried]) -> Float[np.ndarray, " N"]:
        """Logarithms by which the best is chosen."""
        return self.features(tried) @ np.array(WEIGHTS)

    def features(self, tried: list[Tried]) -> Float[np.ndarray, "N 8"]:
        """What speaks for each mask: how well it is set off; how much it takes in of what differs
        from the scene; how common its colours are along limbs; how much better one motion explains
        it than what is around it, as shares and as differences; how far the other masks, which grew
        at other sizes, agree with it; how large it is; and, if the click is on a person, how little
        it takes in of the scene beside them."""
        masks = [t.soft > 0.5 for t in tried]
        part, bins = self._unexplained(masks), bins_of(self.footage.colors(self.i))
        taken = [0.0 if part is None else (m & part).sum() / part.sum() for m in masks]
        flat = np.stack([m.ravel() for m in masks]).astype(np.float32)
        area, both = flat.sum(1), flat @ flat.T
        alike = both / (area[:, None] + area - both)
        return np.stack((
            np.log(np.maximum(self.quality(tried), POOR)),
            np.zeros(len(masks)) if part is None else np.log(np.array(taken) + 1e-3),
            [of_limbs(self.footage, self.i, m, bins) for m in masks],
            *np.stack([self._moves_alone(m) for m in masks], -1),
            (alike.sum(1) - 1) / max(len(masks) - 1, 1),
            np.log(area),
            np.log([min(1 - self._of_scene(m) + BESIDE, 1) for m in masks]),
        ), -1)  # fmt: skip

    def _moves_alone(self, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "2"]:
        """How much one motion sets a mask off, the mean over the frames beside it; zeros where
        there are none. A frame in which it is not found again counts as zeros, and one in which
        nothing moves against it not at all."""
        rows = self.motion.sets_off(mask)
        rows = rows[(np.abs(rows[:, :2]) > STILL).any(1)]
        said = rows[:, :2].clip(-MOVING, MOVING) * rows[:, 2:]
        return said.mean(0) if len(said) else np.zeros(2)

    def _of_scene(self, mask: Bool[np.ndarray, "h w"]) -> float:
        """The share of a mask, grown from a click on a person, that is beside them and looks as the
        scene does; 0 of other clicks."""
        if not self.on_person:
            return 0.0
        still = (self.away <= SCENE) & ~self.footage.person[self.i]
        return float((mask & still).sum() / max(mask.sum(), 1))

    def _unexplained(self, masks: list[np.ndarray]) -> Bool[np.ndarray, "h w"] | None:
        """The part of what differs from the scene and is no body that all masks meet; None where
        there is none, or most of the picture does."""
        if self.on_person:
            return None
        changed = (np.nan_to_num(self.away, nan=0.0) > UNEXPLAINED[1]) & ~self.footage.body(self.i)
        labels, _ = ndimage.label(ndimage.binary_closing(changed))
        own = np.bincount(labels[np.all(masks, axis=0)], minlength=2)
        part = labels == 1 + own[1:].argmax()
        return part if own[1:].max() > 0 and part.sum() < 0.1 * part.size else None


def of_limbs(
    footage: Footage, i: int, mask: Bool[np.ndarray, "h w"], bins: Int[np.ndarray, "h w"]
) -> float:
    """How common the colours of a mask's pixels are along limbs; where these are unknown, on the
    rest of a person that it lies on.

    Args:
        bins: of the frame's colours.
    """
    if footage.limbs is None:
        on = float(footage.person[i][mask].mean())
        return 0.5 * on * of_person(footage, i, mask) if on else 0.0
    return float(like_limbs(footage.limbs, bins[mask]).mean())


def like_limbs(limbs: Float[np.ndarray, " B"], bins: Int[np.ndarray, " N"]) -> np.ndarray:
    """How common the colour of each pixel of a mask is along limbs, [N], against how common it is
    in the mask, 0 to 1.

    Args:
        limbs: histogram of colours along limbs. bins: of the mask's pixels.
    """
    own = histogram(bins, np.ones(len(bins)))
    return np.minimum(1, limbs[bins] / (own[bins] + 1e-6))


def looks_like_person(footage: Footage, found: PromptedMask) -> bool:
    """Whether what was clicked on the person's mask has the colours of the rest of it. A thing that
    is held in front of a person lies on their mask, too, but looks otherwise, or is beyond their
    limbs."""
    i, mask = found.frame, found.soft > 0.5
    if not found.on_person or footage.held[i][mask].mean() > HELD:
        return False
    return of_person(footage, i, mask) > OF_PERSON


def of_person(footage: Footage, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
    """The share of a mask's pixels for which the person has as many of their colour beside it, and
    along their limbs: a mask of a person may have taken in other things that look alike."""
    rest = footage.person[i] & ~ndimage.binary_dilation(mask, iterations=2 * footage.unit)
    bins = bins_of(footage.colors(i))
    own, theirs = (region.sum() * histogram(bins, region * 1.0) for region in (mask, rest))
    if footage.limbs is not None:
        theirs = np.minimum(theirs, COMMON * rest.sum() * footage.limbs)
    return float(np.minimum(own, theirs).sum() / max(mask.sum(), 1))


def lies_on_people(footage: Footage, i: int, mask: Bool[np.ndarray, "h w"], most: float) -> bool:
    """Whether a mask lies on people and a share of it above `most` has their colours: it may be the
    hand that held the object, or a shirt before which it was."""
    on_person = footage.person[i][mask].mean() >= ON_PERSON
    return bool(on_person and of_person(footage, i, mask) > most)


def _novelty(masks: list[np.ndarray], away: np.ndarray, diagonal: float) -> np.ndarray:
    """From 0.3 to 1: less for masks that take in more of the unchanged scene than others do."""
    changed = np.nan_to_num(away, nan=0.0) > SCENE
    # the inside of a plain thing that moves little looks unchanged: only its rim differs
    filled = ndimage.binary_closing(changed, iterations=max(1, round(0.012 * diagonal)))
    share = np.array([(filled & m).sum() / max(m.sum(), 1) for m in masks])
    if share.max() < 0.3:
        return np.ones(len(masks))
    return 0.3 + 0.7 * np.minimum(1, share / (0.8 * share.max()))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union; 1 where both are empty."""
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 1.0


def _reaching(mask: Bool[np.ndarray, "h w"], box: np.ndarray) -> float:
    """Overlap of a box and the one around a mask."""
    y, x = np.nonzero(mask)
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()]) + 1
    both = np.prod(np.maximum(np.minimum(high, box[2:]) - np.maximum(low, box[:2]), 0))
    return float(both / (np.prod(high - low) + np.prod(box[2:] - box[:2]) - both))


def _plausible(footage: Footage, i: int, mask: np.ndarray, on_person: bool) -> float:
    """Less for huge masks, and those that spill onto the person though the prompt is not on one."""
    fits = min(1.0, (0.1 * mask.size / max(mask.sum(), 1)) ** 0.5)
    both = (mask & footage.person[i]).sum()
    if on_person:  # the person's mask took the object in: a mask of the person is no object's
        taken = both / footage.person[i].sum()
        return fits * float(np.clip((LARGEST - taken) / (LARGEST - USUAL), 0, 1))
    return fits * float(1 - both / max(mask.sum(), 1))


def scaled(prompt: FramePrompt, footage: Footage):
    """Points inside and outside, and the box, in pixels of the footage."""
    s = footage.scale
    inside = np.array([(p.x * s, p.y * s) for p in prompt.points if p.inside]).reshape(-1, 2)
    outside = np.array([(p.x * s, p.y * s) for p in prompt.points if not p.inside]).reshape(-1, 2)
    return inside, outside, None if prompt.box is None else np.array(prompt.box) * s


def _disc(shape: tuple[int, int], points: np.ndarray, radius: float) -> Bool[np.ndarray, "h w"]:
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    found = np.zeros(shape, bool)
    for px, py in points:
        found |= np.hypot(x - px, y - py) <= radius
    return found


def _filled(shape: tuple[int, int], box: np.ndarray) -> Bool[np.ndarray, "h w"]:
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    return (x > box[0]) & (x < box[2]) & (y > box[1]) & (y < box[3])


def _evidence(
    person: np.ndarray, away: np.ndarray, on_person: bool, at_rest: bool, boxed: bool
) -> np.ndarray:
    """Log-odds from the person's mask and from the scene.

    The person's mask often takes in the rim of what they hold, and a box says how much.

    A thing that rests where it is clicked is part of the scene, which then says nothing of it.
    """
    odds = np.where(person, -0.3 if on_person else -0.8 if boxed else -1.6, 0.0)
    if not at_rest:
        changed = np.nan_to_num(2.0 * np.tanh((away - 5) / 3), nan=0.0)
        # on the person everything has changed, which says nothing of an object there
        odds = odds + (np.minimum(changed, 0) if on_person else changed)
    return odds.astype(np.float32)


@dataclass(frozen=True)
class _Growth:
    """Masks grown from the seeds of one frame: colours and mask in turns, as in GrabCut (Rother
    2004).

    Attributes:
        fixed: log-odds of pixels that do not change on the way. known: colours of the object.
    """

    footage: Footage
    i: int
    fixed: Float[np.ndarray, "h w"]
    center: Float[np.ndarray, "2"]
    seeds: Float[np.ndarray, "N 2"]
    known: ColorModel | None
    box: np.ndarray | None
    colors: Float[np.ndarray, "h w 3"]

    def masks(self, radii: tuple[float, ...] = RADII) -> list[Tried]:
        """Those that grow, at several sizes, or odds of a box. A click is seldom in the middle:
        each size grows once more about the middle and in the shape of what it grew to."""
        if self.box is not None:
            half = float(max(self.box[2:] - self.box[:2])) / 2
            return _steadied([t for odds in INSIDE if (t := self._grown(half, odds)) is not None])
        reach = float(np.hypot(*(self.seeds - self.center).T).max())
        families: list[list[Tried]] = [[] for _ in range(1 + AGAIN)]
        for radius in radii:
            found, before = self._grown(reach + radius * self.footage.diagonal), None
            for family in families:
                if found is None:
                    break
                family.append(found)
                mask = found.soft > 0.5
                if before is None or overlap(mask, before) < GROWN:
                    found = self._grown(found.spread, about=_ellipse(mask))
                before = mask
        return [t for family in families for t in _steadied(family)]

    def _grown(
        self, spread: float, inside: float = 0.0, about: tuple[np.ndarray, np.ndarray] | None = None
    ) -> Tried | None:
        """inside: log-odds of the pixels of `box`. about: middle and shape of where it is sought,
        as a matrix whose square root an ellipse's axes are; None: around the seeds."""
        middle = self.center if about is None else about[0]
        if about is not None:
            spread = float(np.sqrt(np.linalg.eigvalsh(about[1])[-1]))
        window = Window.around(middle[0], middle[1], 1.6 * spread + 4)
        colors = window.cut(self.colors)
        valid = window.inside(self.footage.shape)
        bins = bins_of(colors)
        fixed = np.where(valid, window.cut(self.fixed), -9)
        y, x = np.mgrid[: window.n, : window.n] + 0.5
        if about is not None:
            off = np.stack((x, y), -1) * window.step + (window.x, window.y) - middle
            far = np.einsum("...a,ab,...b", off, np.linalg.inv(about[1]), off)
            space = 1.5 * (1 - far).clip(-2.5, 1)
        elif self.box is None:
            cx, cy = window.cells(*np.asarray(self.seeds, float).T)
            distance = np.min([np.hypot(x - a, y - b) for a, b in zip(cx, cy)], 0)
            # a seed's own surroundings count, so that a line of clicks marks a long thing
            space = 1.5 * (1 - (distance * window.step / spread) ** 2).clip(-2.5, 1)
        else:
            x0, y0 = window.cells(self.box[0], self.box[1])
            x1, y1 = window.cells(self.box[2], self.box[3])
            space = np.where((x > x0) & (x < x1) & (y > y0) & (y < y1), inside, -8.0)
        soft = 1 / (1 + np.exp(-(space + fixed)))
        if self.box is None:
            soft = soft * (space > 0.4)
        whole = bins_of(self.colors[::3, ::3])
        others = histogram(whole, np.ones(whole.shape))
        person = self.footage.person[self.i]
        if (window.cut(person) * valid).mean() > 0.05:  # hands have their colours
            theirs = person & (window.paste(np.ones((window.n, window.n)), person.shape) == 0)
            if theirs.any():
                bins_all = bins_of(self.colors)
                others = 0.4 * others + 0.6 * histogram(bins_all, theirs * 1.0)
        for _ in range(ROUNDS):
            near = histogram(bins, (soft < 0.5) * valid * 1.0)
            inner = histogram(bins, np.where(soft > 0.5, soft, 0) + 1e-9)
            if self.known is not None:
                inner = 0.5 * (inner + self.known.inside)
            odds = 0.8 * odds_of(inner, 0.7 * near + 0.3 * others)[bins] + space + fixed
            soft = walked(np.where(valid, odds, -9), colors)
        mask = _connected(soft > 0.5, window, self.seeds)
        if mask.sum() < 9:
            return None
        score = set_off(mask, colors, bins, valid)
        soft = np.where(ndimage.binary_dilation(mask, iterations=2), soft, 0)
        soft = window.paste(soft, self.footage.shape) / np.float32(255)
        return Tried(soft, score, spread)

    def unexplained(self, away: Float[np.ndarray, "h w"]) -> list[Tried]:
        """The parts that hold a seed of what neither the scene nor the body explains: they keep
        what is thin."""
        found = []
        for least in UNEXPLAINED:
            region = (np.nan_to_num(away) > least) & (self.fixed > -6)
            region &= ~self.footage.body(self.i)
            mask = _connected(
                ndimage.binary_closing(region) | (self.fixed >= 6), _whole(region), self.seeds
            )
            mask = ndimage.binary_opening(mask, np.ones((2, 2))) | (mask & (self.fixed >= 6))
            if not 9 <= mask.sum() < 0.1 * mask.size:
                continue
            y, x = np.nonzero(mask)
            half = 0.5 * max(np.ptp(x), np.ptp(y)) + 8
            window = Window.around((x.min() + x.max()) / 2, (y.min() + y.max()) / 2, half)
            colors = window.cut(self.colors)
            valid = window.inside(self.footage.shape)
            score = set_off(window.cut(mask) > 0.5, colors, bins_of(colors), valid)
            found.append(Tried(mask.astype(np.float32), score, half))
        return _steadied(found)


def _ellipse(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Middle x, y of a mask, and the matrix of an ellipse somewhat larger than its own."""
    at = np.argwhere(mask)[:, ::-1] + 0.5
    return at.mean(0), ROOM * 4 * np.cov(at.T) + np.eye(2)


def _whole(image: np.ndarray) -> Window:
    """A window whose cells are a frame's pixels."""
    return Window(0, 0, max(image.shape), 1)


def _connected(mask: np.ndarray, window: Window, seeds: np.ndarray) -> np.ndarray:
    """The parts of a mask that hold a seed, holes filled."""
    labels, _ = ndimage.label(mask)
    cells = [np.asarray(window.cells(*s)).astype(int).clip(0, window.n - 1) for s in seeds]
    wanted = {int(labels[c[1], c[0]]) for c in cells} - {0}
    kept = np.isin(labels, list(wanted))
    return ndimage.binary_fill_holes(kept) if kept.any() else kept


def set_off(mask: np.ndarray, colors: np.ndarray, bins: np.ndarray, valid: np.ndarray) -> float:
    """How well a mask's rim is an edge and its colours are not those around it, 0 to 1."""
    grown, shrunk = (
        ndimage.binary_dilation(mask, iterations=3) & valid,
        ndimage.binary_erosion(mask, iterations=3),
    )
    rim = ndimage.binary_dilation(mask) & ~ndimage.binary_erosion(mask)
    smooth = ndimage.gaussian_filter(colors, (1, 1, 0))
    edge = np.sqrt(sum(ndimage.sobel(smooth, a)[..., :] ** 2 for a in (0, 1)).sum(-1)) / 8
    here = edge[rim & valid]
    border = (rim & ~ndimage.binary_erosion(valid, iterations=2)).sum() / max(rim.sum(), 1)
    crisp = float(np.mean(here / (here + 2.0))) if len(here) else 0.0
    ring = histogram(bins, (grown & ~mask) * 1.0)
    inner = histogram(bins, (mask & ~shrunk) * 1.0)
    apart = 1 - float(np.sqrt(ring * inner).sum())
    return float((0.5 * crisp + 0.5 * apart) * (1 - 0.5 * border))
