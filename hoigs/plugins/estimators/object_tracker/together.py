"""What moves together with a mask, and unlike the scene, from a frame to those beside it.

A thing is what moves as one. The motion of a mask's pixels, an affine map, foretells the pixels of
the same thing beside it too, and none of the background; the motion of the scene does the reverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage, Window, to_features
from hoigs.plugins.estimators.object_tracker.scene import Scene, carried

BESIDE = (-4, -2, -1, 1, 2, 4)  # frames to which motions are taken
ROOM = 0.5  # of a window's side, by which things are looked for beside it
MOVED = 1.5  # pixels, by which a thing moves unlike the scene, so that this tells of it
ROUNDS, STIFF = 6, 0.02  # of the fit of an affine map, and its weight against turns and stretches
NOISE = 6.0  # units of colour that differ by chance
RING = 0.3  # of a mask's radius: what is around it


@dataclass(frozen=True)
class Together:
    """How much better than the scene's the motion of a mask foretells the pixels of a window, from
    -1 to 1; 0 where it is all the same."""

    window: Window
    gain: Float[np.ndarray, "n n"]

    def odds(self, shape: tuple[int, int]) -> Float[np.ndarray, "h w"]:
        """The gain of all pixels of a frame."""
        full = self.window.paste(0.5 + 0.5 * self.gain, shape).astype(np.float32) / 127.5 - 1
        known = self.window.paste(np.ones_like(self.gain), shape) > 0
        return np.where(known, full, 0)

    def agreement(self, mask: Bool[np.ndarray, "h w"]) -> float:
        """How much more what is inside of a mask moves so than what is around it, -2 to 2."""
        inside = self.window.cut(mask) > 0.5
        if not inside.any():
            return 0.0
        reach = max(2, round(RING * np.sqrt(inside.sum() / np.pi)))
        ring = ndimage.binary_dilation(inside, iterations=reach) & ~inside
        around = self.gain[ring].mean() if ring.any() else 0.0
        return float(self.gain[inside].mean() - around)


def together(
    footage: Footage, scene: Scene, i: int, soft: Float[np.ndarray, "h w"]
) -> Together | None:
    """By the motion of the pixels of a soft mask; None where it moves as the scene does."""
    y, x = np.nonzero(soft > 0.5)
    if len(y) < 6:
        return None
    half = 0.5 * max(np.ptp(x), np.ptp(y)) + 1
    middle = (x.min() + x.max() + 1) / 2, (y.min() + y.max() + 1) / 2
    window = Window.around(*middle, 2.2 * half + 6)
    here, weight = _smooth(footage, i, window), window.cut(soft)
    cells = np.moveaxis(np.mgrid[: window.n, : window.n][::-1], 0, -1) + 0.5
    pixels = cells * window.step + (window.x, window.y)
    gains = []
    for j in (i + k for k in BESIDE):
        if not 0 <= j < len(footage):
            continue
        slack = max(4, int(ROOM * window.n))
        room = Window(
            window.x - slack * window.step, window.y - slack * window.step,
            window.n + 2 * slack, window.step,
        )  # fmt: skip
        there = _smooth(footage, j, room)
        to_scene = np.stack(room.cells(*np.moveaxis(carried(scene, pixels, i, j), -1, 0)), -1)
        still = _sampled(there, to_scene)
        nothing = np.zeros(there.shape[:2])
        dx, dy, _ = shift_of(there, here, weight, nothing, float(slack))
        to = _fitted(here, there, weight, cells, np.array((slack + dx, slack + dy)))
        inside = weight > 0.5
        if np.hypot(*(to - to_scene)[inside].T).mean() * window.step < MOVED:
            continue
        by_scene, by_thing = (
            np.linalg.norm(other - here, axis=-1) for other in (still, _sampled(there, to))
        )
        gains.append((by_scene - by_thing) / (by_scene + by_thing + NOISE))
    return Together(window, np.mean(gains, 0)) if gains else None


def _smooth(footage: Footage, i: int, window: Window) -> Float[np.ndarray, "n n 3"]:
    return ndimage.gaussian_filter(to_features(window.cut(footage.lab[i])), (0.7, 0.7, 0))


def _sampled(image: Float[np.ndarray, "m m C"], at: Float[np.ndarray, "a b 2"]) -> np.ndarray:
    """Colours at places x, y, of which (0.5, 0.5) is the middle of the first cell."""
    where = np.moveaxis(at, -1, 0)[::-1] - 0.5
    layers = np.moveaxis(image, -1, 0)
    return np.stack(
        [ndimage.map_coordinates(c, where, order=1, mode="nearest") for c in layers], -1
    )


def _fitted(
    here: Float[np.ndarray, "n n 3"],
    there: Float[np.ndarray, "m m 3"],
    weight: Float[np.ndarray, "n n"],
    cells: Float[np.ndarray, "n n 2"],
    shift: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "n n 2"]:
    """Where the cells of a window lie in a wider one, by the affine map that makes the weighted
    ones alike (Lucas and Kanade 1981), from a shift on."""
    inside = weight > 0.3
    points, colors, w = cells[inside], here[inside], weight[inside]
    middle = points.mean(0)
    size = max(float(np.abs(points - middle).max()), 1.0)
    local = (points - middle) / size
    slope = np.stack((ndimage.sobel(there, 1), ndimage.sobel(there, 0)), -1) / 8  # m m 3 2
    steps = np.concatenate((np.zeros((2, 2)), np.zeros((1, 2))))  # rows: by x, by y, shift
    basis = np.concatenate((local, np.ones((len(local), 1))), 1)
    penalty = np.diag(np.repeat((STIFF, STIFF, 0.0), 2)) * len(points)
    for _ in range(ROUNDS):
        at = (points + shift + basis @ steps)[None]
        away = _sampled(there, at)[0] - colors
        grey = [_sampled(slope[..., a], at)[0] for a in range(2)]
        sure = w / (1 + (away**2).sum(-1) / 15**2)  # of Geman and McClure: what hides it
        # rows of the Jacobian: basis by direction
        jacobian = np.einsum("nb,ncd->ncbd", basis, np.stack(grey, -1)).reshape(len(points), 3, 6)
        normal = np.einsum("ncp,n,ncq->pq", jacobian, sure, jacobian) + penalty * 60
        normal += np.eye(6) * 1e-3
        gradient = np.einsum("ncp,n,nc->p", jacobian, sure, away) + penalty @ steps.ravel() * 60
        change = np.linalg.solve(normal, gradient).reshape(3, 2)
        length = np.abs(change).max()
        steps = steps - change * min(1.0, 0.15 * size / max(length, 1e-9))
    whole = np.concatenate(((cells - middle) / size, np.ones((*cells.shape[:2], 1))), -1)
    return cells + shift + whole @ steps


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
