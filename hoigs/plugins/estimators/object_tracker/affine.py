"""How a thing turned and grew since the last frame: an affine map between two windows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

BLURS = (5.0, 2.5, 1.2)  # cells: first far motions, then exact ones
ROUNDS = 8
SPREAD = 12.0  # difference of colours above which a pixel counts little: a hand, a highlight
STIFF = 1.0  # squared gradient at which a change of shape is as probable as none
LARGEST = 0.45  # change of shape in one frame above which the map is not believed
GAIN = 0.9  # of the difference of colours that has to remain at most


def matched(
    colors: Float[np.ndarray, "n n 3"],
    template: Float[np.ndarray, "n n 3"],
    soft: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "n n 3"], Float[np.ndarray, "n n"], float]:
    """The template and its soft mask as they lie in `colors`, unchanged where no map fits better;
    and how far its colours are then from those there, 0 to 1.

    Registration by gradients (Lucas and Kanade 1981; Baker and Matthews 2004, inverse
    compositional) of the masked pixels, robust against what covers some of them.
    """
    rows, columns = np.nonzero(soft > 0.5)
    if len(rows) < 30:
        return template, soft, 1.0
    middle = np.array([rows.mean(), columns.mean()])
    place = np.stack((rows, columns), -1) - middle
    size = np.sqrt((place**2).sum(-1).mean())
    # cells of the image = middle + shape @ (cells of the template - middle) + shift
    shape, shift = np.eye(2), np.zeros(2)
    for blur in BLURS:
        one, two = (ndimage.gaussian_filter(c, (blur, blur, 0)) for c in (template, colors))
        slopes = np.stack([ndimage.sobel(one, a)[rows, columns] / 8 for a in (0, 1)], -1)
        known = one[rows, columns]
        near = place / size
        steps = np.concatenate(
            (slopes, slopes * near[:, None, :1], slopes * near[:, None, 1:]), -1
        )  # [P, 3, 6]: by shift, then by the two columns of the shape
        for _ in range(ROUNDS):
            away = _sampled(two, middle + place @ shape.T + shift) - known
            weight = 1 / (1 + (away**2).sum(-1) / SPREAD**2) ** 2
            normal = np.einsum("pci,pcj,p->ij", steps, steps, weight)
            normal += np.diag([0.1, 0.1, *[STIFF] * 4]) * len(rows)
            change = np.linalg.solve(normal, np.einsum("pci,pc,p->i", steps, away, weight))
            turn = np.eye(2) + np.stack((change[2:4], change[4:6]), -1) / size
            # the template moved by `change` looks like the image: it is undone first
            shape = shape @ np.linalg.inv(turn)
            shift = shift - shape @ change[:2]
            if np.abs(change).max() < 0.02:
                break
    before, after = (_difference(two, known, middle + p) for p in (place, place @ shape.T + shift))
    values = np.linalg.svd(shape, compute_uv=False)
    if after > GAIN * before or np.abs(np.log(np.maximum(values, 1e-3))).max() > LARGEST:
        return template, soft, before
    back = np.linalg.inv(shape)
    offset = middle - back @ (middle + shift)
    moved = [ndimage.affine_transform(c, back, offset, order=1, mode="nearest")
             for c in (*np.moveaxis(template, -1, 0), soft)]  # fmt: skip
    return np.stack(moved[:3], -1), moved[3], after


def _sampled(image: np.ndarray, at: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    return np.stack(
        [ndimage.map_coordinates(image[..., c], at.T, order=1, mode="nearest") for c in range(3)],
        -1,
    )


def _difference(image: np.ndarray, known: np.ndarray, at: np.ndarray) -> float:
    """Mean of the robust squared difference of colours."""
    away = ((_sampled(image, at) - known) ** 2).sum(-1)
    return float((away / (away + SPREAD**2)).mean())
