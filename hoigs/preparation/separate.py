"""One mask of person and object together, taken apart by the fitted body and by colour."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from hoigs.preparation.masks import MaskStack, largest_parts

BINS = 24  # a colour channel
MARGIN = 0.03  # of the image's longer side: how far clothes reach beyond the body
Images = Callable[[], Iterable[UInt8[np.ndarray, "H W 3"]]]


def separate(
    images: Images, together: MaskStack, bodies: MaskStack, rounds: int = 3
) -> tuple[MaskStack, MaskStack]:
    """The person's and the object's masks, which share out `together`.

    Every pixel has a log-odds of being the object: from its distance to the body's silhouette
    (soft, because clothes reach beyond it and fits are off), from the two colour histograms that
    the masks of the round before give over all frames, from the object's place in the frames
    before and after, and from its neighbours (a mean field with a box neighbourhood). It is
    GrabCut's idea (Rother et al. 2004) with histograms in place of mixtures and a mean field in
    place of the cut.

    Args:
        images: gives the frames anew on every call.
        together: person and object. bodies: silhouettes of the fitted body, unclothed.
        rounds: of colours and masks, after the first masks from the silhouettes alone.

    Returns:
        human, object
    """
    trust = [_trust(b, t) for b, t in zip(bodies, together, strict=True)]
    odds = [w * _silhouette_odds(b) for b, w in zip(bodies, trust, strict=True)]
    objects = [t & (o > 0) for t, o in zip(together, odds, strict=True)]
    for turn in range(rounds):
        colors = ColorOdds()
        for image, mask, part, odd, w in zip(images(), together, objects, odds, trust, strict=True):
            if w > 0.5 * max(trust):
                # pixels on the silhouette's border teach nothing
                sure = mask & (np.abs(odd) > w)
                colors.learn(image, sure & part, sure & ~part)
        colors.settle()
        places = [_place(objects, i) if turn else 0.0 for i in range(len(objects))]
        objects = [
            largest_parts(_mean_field(odd + colors(image) + place, mask), smallest=0.25)
            for image, mask, odd, place in zip(images(), together, odds, places, strict=True)
        ]
    humans = MaskStack(t & ~o for t, o in zip(together, objects, strict=True))
    return humans, MaskStack(objects)


def _trust(body: Bool[np.ndarray, "H W"], together: Bool[np.ndarray, "H W"]) -> float:
    """0.2..1: how much of a silhouette lies on the mask that it ought to lie on."""
    inside = (body & together).sum() / max(1, body.sum())
    return float(np.clip((inside - 0.6) / 0.3, 0.2, 1.0))


def _silhouette_odds(body: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Log-odds of the object from the signed distance to a silhouette: -3 inside, 3 far off."""
    if not body.any():
        return np.zeros(body.shape, np.float32)
    scale = MARGIN * max(body.shape)
    outside = ndimage.distance_transform_edt(~body)
    inside = ndimage.distance_transform_edt(body)
    return (3 * np.tanh((outside - inside - scale) / scale)).astype(np.float32)


def _place(objects: list[Bool[np.ndarray, "H W"]], frame: int) -> Float[np.ndarray, "H W"]:
    """Log-odds -1..1 from where the object is in the two frames before and after."""
    near = [objects[i] for i in range(frame - 2, frame + 3) if 0 <= i < len(objects) and i != frame]
    if not near:
        return np.zeros(objects[frame].shape, np.float32)
    mean = np.mean(near, axis=0, dtype=np.float32)
    return 2 * ndimage.uniform_filter(mean, int(MARGIN * max(mean.shape)) | 1) - 1


class ColorOdds:
    """Log-odds of object against person by colour, from histograms over all frames."""

    def __init__(self) -> None:
        self._counts = np.zeros((2, BINS, BINS, BINS))
        self._odds = np.zeros((BINS, BINS, BINS), np.float32)

    def learn(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        object_mask: Bool[np.ndarray, "H W"],
        human_mask: Bool[np.ndarray, "H W"],
    ) -> None:
        for i, mask in enumerate((object_mask, human_mask)):
            cells = _bins(image[mask]) @ np.array([BINS * BINS, BINS, 1])
            self._counts[i] += np.bincount(cells, minlength=BINS**3).reshape(self._counts[i].shape)

    def settle(self) -> None:
        """Smooths the histograms and takes their ratio; colours never seen say nothing."""
        totals = self._counts.sum((1, 2, 3))
        if (totals == 0).any():
            return
        smooth = np.stack([ndimage.gaussian_filter(c, 1.0) for c in self._counts])
        likelihood = smooth / totals[:, None, None, None]
        floor = 0.1 / BINS**3 + 0.02 * likelihood.max() / BINS
        ratio = np.log(likelihood[0] + floor) - np.log(likelihood[1] + floor)
        self._odds = np.clip(ratio, -4, 4).astype(np.float32)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
        index = _bins(image)
        return self._odds[index[..., 0], index[..., 1], index[..., 2]]


def _bins(pixels: UInt8[np.ndarray, "*batch 3"]) -> np.ndarray:
    return pixels.astype(np.int64) * BINS // 256


def _mean_field(
    odds: Float[np.ndarray, "H W"],
    mask: Bool[np.ndarray, "H W"],
    reach: float = 0.02,
    weight: float = 4.0,
    steps: int = 8,
) -> Bool[np.ndarray, "H W"]:
    """Object pixels of `mask` after neighbours have agreed; reach in parts of the longer side."""
    size = max(3, int(reach * max(mask.shape)) | 1)
    inside = mask.astype(np.float32)
    norm = np.maximum(ndimage.uniform_filter(inside, size), 1e-3)
    belief = np.tanh(odds / 2) * inside
    for _ in range(steps):
        neighbours = ndimage.uniform_filter(belief, size) / norm
        belief = np.tanh((odds + weight * neighbours) / 2) * inside
    return mask & (belief > 0)
