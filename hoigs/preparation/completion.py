"""What no frame shows, continued from the rest of the picture by patches of it.

Every patch that reaches into the hole is made as similar as possible to some patch of what is known
(Wexler et al. 2007, Space-Time Completion of Video), from coarse to fine; the similar patches are
found by trying those of neighbours and random ones (Barnes et al. 2009, PatchMatch). Edges and
patterns go on that way, where the nearest known pixel, or a mean of them, leaves a smear in the
shape of whoever stood before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

PATCH = 7  # pixels, odd
COARSEST = 3 * PATCH  # pixels of the smaller side
ROUNDS, FINEST_ROUNDS = 8, 1  # of matching and blending, at each level and at the finest
SWEEPS = 4  # of looking at neighbours' matches, in a round
LEVEL = 30.0  # squared grey values that a match costs which is a tenth of the height above or below
STEADY = 50.0  # squared grey values below which a better match has no more say
ISLAND = 0.02  # of the picture: a smaller known part may be what a mask leaves out of somebody


def completed(
    image: UInt8[np.ndarray, "H W 3"], known: Bool[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """The image with the pixels that are not `known` made from patches of the others.

    The same image gives the same result. Known pixels stay, but nothing is taken from small islands
    of them; where no whole patch is known, the nearest known pixel is copied.
    """
    if known.all() or not known.any():
        return image
    levels = [(image.astype(np.float32), _without_islands(known))]
    while min(levels[-1][1].shape) >= 2 * COARSEST:
        levels.append(_halved(*levels[-1]))
    rng = np.random.default_rng(0)
    coarse, seen = levels[-1]
    rows, columns = ndimage.distance_transform_edt(
        ~seen, return_distances=False, return_indices=True
    )
    filled, match = coarse[rows, columns], None
    for level in reversed(range(len(levels))):
        picture, seen = levels[level]
        if filled.shape != picture.shape:
            filled = np.where(seen[..., None], picture, _doubled(filled, picture.shape))
        filled, match = _filled(filled, picture, seen, match, rng, finest=level == 0)
    return np.where(known[..., None], image, filled.round().clip(0, 255).astype(np.uint8))


def _without_islands(known: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    parts, _ = ndimage.label(known)
    sizes = np.bincount(parts.ravel())
    large = sizes > min(ISLAND * known.size, sizes[1:].max() - 1)
    large[0] = False
    return large[parts]


def _halved(
    image: Float[np.ndarray, "H W 3"], known: Bool[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Half the size: means of the known pixels of each four; known where two of them are."""
    height, width = (side // 2 for side in known.shape)
    weight = known[: 2 * height, : 2 * width].astype(np.float32)[..., None]

    def summed(values: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "h w C"]:
        return values.reshape(height, 2, width, 2, -1).sum((1, 3))

    count = summed(weight)
    mean = summed(image[: 2 * height, : 2 * width] * weight) / np.maximum(count, 1)
    return mean, count[..., 0] >= 2


def _doubled(
    image: Float[np.ndarray, "h w 3"], shape: tuple[int, ...]
) -> Float[np.ndarray, "H W 3"]:
    large = image.repeat(2, 0).repeat(2, 1)
    over = [(0, max(0, wanted - has)) for wanted, has in zip(shape, large.shape, strict=True)]
    return np.pad(large, over, mode="edge")[: shape[0], : shape[1]]


@dataclass(frozen=True)
class _Match:
    """The known place that each place of the picture is like: its own, outside of the hole."""

    rows: Int[np.ndarray, "H W"]
    columns: Int[np.ndarray, "H W"]

    def doubled(
        self, y: Int[np.ndarray, " N"], x: Int[np.ndarray, " N"]
    ) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
        """The matches of places in a picture of twice the size."""
        above = np.minimum(y // 2, len(self.rows) - 1), np.minimum(x // 2, self.rows.shape[1] - 1)
        return 2 * self.rows[above] + y % 2, 2 * self.columns[above] + x % 2


def _filled(
    filled: Float[np.ndarray, "H W 3"],
    picture: Float[np.ndarray, "H W 3"],
    known: Bool[np.ndarray, "H W"],
    coarse: _Match | None,
    rng: np.random.Generator,
    *,
    finest: bool,
) -> tuple[Float[np.ndarray, "H W 3"], _Match | None]:
    """One level: the hole's pixels as means of what the patches over them are like."""
    height, width = known.shape
    radius, square = PATCH // 2, np.ones((PATCH, PATCH), dtype=bool)
    inner = np.zeros_like(known)
    inner[radius : height - radius, radius : width - radius] = True
    whole = ndimage.binary_erosion(known, square, border_value=1) & inner
    y, x = np.nonzero(ndimage.binary_dilation(~known, square) & inner)
    sources = np.flatnonzero(whole)
    if not len(sources) or not len(y):
        return filled, coarse
    dy, dx = (g.ravel() for g in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    around = dy * width + dx
    place = np.full((height, width), -1)
    place[y, x] = np.arange(len(y))
    flat, here = picture.reshape(-1, 3), y * width + x
    match = rng.choice(sources, len(y))
    if coarse is not None:
        rows, columns = coarse.doubled(y, x)
        likely = np.clip(rows, 0, height - 1) * width + np.clip(columns, 0, width - 1)
        match = np.where(whole.ravel()[likely], likely, match)

    def cost(other: Int[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
        apart = np.square(patches - flat[other[:, None] + around]).sum((1, 2)) / PATCH**2
        return apart + LEVEL * np.square((other // width - y) / (0.1 * height))

    for _ in range(FINEST_ROUNDS if finest else ROUNDS):
        patches = filled.reshape(-1, 3)[here[:, None] + around]
        best = cost(match)

        def take(other: Int[np.ndarray, " N"]) -> None:
            nonlocal match, best
            other = np.where(whole.ravel()[other], other, match)
            price = cost(other)
            match, best = np.where(price < best, other, match), np.minimum(price, best)

        for sweep in range(1 if finest else SWEEPS):
            for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                step = 1 + 2 * (sweep % 2)  # far matches arrive sooner
                ny, nx = y + step * down, x + step * right
                inside = (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
                beside = place[ny.clip(0, height - 1), nx.clip(0, width - 1)]
                other = match[beside] - step * (down * width + right)
                valid = inside & (beside >= 0) & (other >= 0) & (other < known.size)
                take(np.where(valid, other, match))
            reach = 0 if finest else max(height, width)
            while reach >= 1:
                rows = match // width + rng.integers(-reach, reach + 1, len(y))
                columns = match % width + rng.integers(-reach, reach + 1, len(y))
                take(rows.clip(0, height - 1) * width + columns.clip(0, width - 1))
                reach //= 2
        filled = _blended(filled, flat, known, (here, match, 1 / (best + STEADY)), around)
    found = np.arange(known.size)
    found[here] = match
    rows, columns = np.divmod(found.reshape(known.shape), width)
    return filled, _Match(rows, columns)


def _blended(
    filled: Float[np.ndarray, "H W 3"],
    source: Float[np.ndarray, "P 3"],
    known: Bool[np.ndarray, "H W"],
    matches: tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"], Float[np.ndarray, " N"]],
    around: Int[np.ndarray, " K"],
) -> Float[np.ndarray, "H W 3"]:
    """Each pixel of the hole as the weighted mean of what the patches over it have there."""
    here, match, weight = matches
    count, total = np.zeros(known.size), np.zeros((known.size, 3))
    for offset in around:
        count[here + offset] += weight
        total[here + offset] += weight[:, None] * source[match + offset]
    mean = (total / np.maximum(count, 1e-12)[:, None]).reshape(filled.shape)
    hole = ~known & (count > 0).reshape(known.shape)
    return np.where(hole[..., None], mean, filled).astype(np.float32)
