"""Values over the frames of a video: gaps interpolated, noise smoothed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def fill_gaps(
    values: Float[np.ndarray, "F *shape"], known: Bool[np.ndarray, " F"]
) -> Float[np.ndarray, "F *shape"]:
    """Linear between known values, constant before the first and after the last."""
    frames, columns = np.arange(len(values)), values.reshape(len(values), -1).T
    filled = [np.interp(frames, frames[known], column[known]) for column in columns]
    return np.stack(filled, 1).reshape(values.shape)


def smooth(values: Float[np.ndarray, "F *shape"], window: int = 9) -> Float[np.ndarray, "F *shape"]:
    """A median of 5 frames against outliers, then parabolas over `window` frames against noise
    (Savitzky and Golay 1964); the median of all values where there are fewer than 5."""
    from scipy import signal  # on use: scipy takes a while to import

    count = len(values)
    if count < 5:
        return np.broadcast_to(np.median(values, axis=0), values.shape).copy()
    padded = np.pad(values, ((2, 2), *((0, 0),) * (values.ndim - 1)), mode="edge")
    median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    window = min(window, count if count % 2 else count - 1)
    return signal.savgol_filter(median, window, 2, axis=0, mode="interp")
