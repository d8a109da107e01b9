"""Where a person's mask takes in the thing they hold: its parts that are far from their limbs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from hoigs.core.interfaces.estimator import VideoRequest

SEEN = 0.5  # visibility from which a landmark counts
# Pairs of MediaPipe's landmarks, and the radius of the limb between them, clothes included, in
# lengths of the torso.
LIMBS = (
    ((11, 12), 0.22), ((11, 23), 0.25), ((12, 24), 0.25), ((23, 24), 0.25),
    ((11, 13), 0.20), ((13, 15), 0.16), ((12, 14), 0.20), ((14, 16), 0.16),
    ((15, 19), 0.16), ((16, 20), 0.16),
    ((23, 25), 0.28), ((25, 27), 0.24), ((24, 26), 0.28), ((26, 28), 0.24),
    ((27, 31), 0.20), ((28, 32), 0.20), ((0, 7), 0.40), ((0, 8), 0.40),
)  # fmt: skip
SHOULDERS, HIPS = (11, 12), (23, 24)


def skeletons(
    video: VideoRequest, numbers: Sequence[int], scale: float
) -> list[Float[np.ndarray, "F 33 4"]]:
    """Each person's landmarks in frames of a video that is enlarged by `scale`."""
    known = None if video.known is None else video.known.landmarks
    enlarged = np.array((scale, scale, 1.0, 1.0), np.float32)
    return [track.image_xyzv[list(numbers)] * enlarged for track in (known or {}).values()]


def held_pixels(
    person: Bool[np.ndarray, "F h w"], people: Sequence[Float[np.ndarray, "F 33 4"]]
) -> Bool[np.ndarray, "F h w"]:
    """Pixels of the mask of all people that no limb reaches; none in frames in which somebody's
    limbs are unknown, who would be taken for a thing."""
    held = np.zeros_like(person)
    torsos = [torso_length(landmarks) for landmarks in people]
    for i in np.flatnonzero(person.any((1, 2))):
        bodies = [
            limbs(person.shape[1:], landmarks[i], torso[i])
            for landmarks, torso in zip(people, torsos, strict=True)
        ]
        known = [body for body in bodies if body is not None]
        if known and len(known) == len(bodies):
            held[i] = person[i] & ~np.any(known, axis=0)
    return held


def torso_length(landmarks: Float[np.ndarray, "F 33 4"]) -> Float[np.ndarray, "F"]:
    """Pixels from the shoulders to the hips, at least 0.8 of what it is over the whole video, since
    a person who bends towards the camera is no thinner. NaN where the video never shows them."""
    middle = [landmarks[:, pair, :2].mean(1) for pair in (SHOULDERS, HIPS)]
    length = np.linalg.norm(middle[0] - middle[1], axis=-1)
    length[(landmarks[:, SHOULDERS + HIPS, 3] < SEEN).any(1)] = np.nan
    if not np.isfinite(length).any():
        return length
    usual = np.nanquantile(length, 0.75)
    return np.fmax(length, 0.8 * usual)


def limbs(
    shape: tuple[int, int], landmarks: Float[np.ndarray, "33 4"], torso: float
) -> Bool[np.ndarray, "h w"] | None:
    """Pixels that the body of one person may cover; None where their torso is not seen."""
    if not (np.isfinite(torso) and (landmarks[[*SHOULDERS, *HIPS], 3] > SEEN).all()):
        return None
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    found = _inside(x, y, landmarks[[11, 12, 24, 23], :2])
    for (a, b), radius in LIMBS:
        # an end that is not seen is still where the limb would be: it is rather body than thing
        start, along = landmarks[a, :2], landmarks[b, :2] - landmarks[a, :2]
        share = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / max(along @ along, 1e-9)
        share = share.clip(0, 1)
        gap = np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1])
        found |= gap < radius * torso
    return found


def _inside(x: np.ndarray, y: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Pixels inside a polygon, by crossings of a ray to the right."""
    found = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, 0), strict=True):
        if y0 != y1:
            found ^= ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return found
