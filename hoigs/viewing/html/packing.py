"""Packing: tracks as bytes, 17 a Gaussian and key before compression.

Positions take 16 bits an axis within the box of the entity over time, logarithms of scales 8 bits
within their range, quaternions, colour and opacity 8 bits a number, colours as a share of the
brightest: transparent Gaussians may be brighter than white. Of every key but the first only the
difference to the key before is stored, and all first bytes come before all second ones, which gzip
likes.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.viewing.html.tracks import Track


def packed(tracks: Sequence[Track]) -> tuple[list[dict[str, Any]], bytes]:
    """A description of every track, and the compressed bytes of all."""
    heads, parts = [], []
    for track in tracks:
        head, data = _track(track)
        heads.append(head)
        parts.append(data)
    return heads, gzip.compress(b"".join(parts), 6, mtime=0)


def _track(track: Track) -> tuple[dict[str, Any], bytes]:
    low, high = _span(track.means)
    small, large = _span(track.log_scales)
    means = _codes(track.means, low, high, 65535)
    scales = _codes(track.log_scales, small, large, 255)
    quats = (track.quats.clamp(-1, 1) * 127).round().to(torch.int64)
    bright = _brightest(track.rgba[..., :3])
    color = torch.cat((track.rgba[..., :3] / bright, track.rgba[..., 3:]), -1)
    rgba = (color.clamp(0, 1) * 255).round().to(torch.int64)
    steps = _steps(means, 65536)
    data = b"".join(
        part.astype(np.uint8).tobytes()
        for part in (steps & 255, steps >> 8, *(_steps(x, 256) for x in (scales, quats, rgba)))
    )
    head = {
        "name": track.name, "motion": track.motion, "count": len(track), "keys": len(track.means),
        "low": low.tolist(), "high": high.tolist(), "small": small.tolist(),
        "large": large.tolist(), "bright": bright, "bytes": len(data),
        "poses": None if track.poses is None else np.round(track.poses.numpy(), 6).tolist(),
    }  # fmt: skip
    return head, data


def _brightest(colors: Float[Tensor, "K N 3"]) -> float:
    """The colour that is stored as 255: 1, or what one in a thousand surpasses."""
    flat = colors.flatten()
    if not len(flat):
        return 1.0
    some = flat[:: len(flat) // 1_000_000 + 1]  # as many as torch sorts
    return max(1.0, float(torch.quantile(some, 0.999)))


def _span(values: Float[Tensor, "K N 3"]) -> tuple[Tensor, Tensor]:
    flat = values.flatten(0, 1).double()
    if not len(flat):
        return torch.zeros(3), torch.ones(3)
    return flat.amin(0), torch.maximum(flat.amax(0), flat.amin(0) + 1e-6)


def _codes(values: Float[Tensor, "K N 3"], low: Tensor, high: Tensor, top: int) -> Tensor:
    return ((values.double() - low) / (high - low) * top).round().to(torch.int64)


def _steps(codes: Tensor, modulus: int) -> np.ndarray:
    """Differences from key to key, channel by channel, modulo the range of a code."""
    array = codes.permute(0, 2, 1).numpy()  # [K, C, N]: equal channels lie together
    array = np.concatenate((array[:1], np.diff(array, axis=0)))
    result: np.ndarray = np.mod(array, modulus)
    return result
