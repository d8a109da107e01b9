"""Min-max quantisation: values as 8 or 16 bits between the minimum and maximum of a channel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Bits = Literal[8, 16]

# names of tensors with 8 bits, by the last part or by any part of the name: 1/510 of their range is
# not visible in an image. Positions and network weights need 16: 1/131070 of 1 m is 0.01 mm
EIGHT = ("quats", "keyframe_quats", "log_scales", "opacity_logits", "sh", "embedding", "mixture")
EIGHT_IN = ("planes.",)


def bits_of(name: str) -> Bits:
    """The number of bits for a tensor of this name."""
    last = name.rpartition(".")[2]
    return 8 if last in EIGHT or any(part in name for part in EIGHT_IN) else 16


@dataclass(frozen=True)
class Levels:
    """A quantised tensor.

    Attributes:
        codes: of the tensor's shape, 0 to 2^bits - 1, int32.
        low, step: float64, of each channel: value = low + step * code. Channels are the last axis;
            a tensor of fewer than two axes is one channel.
    """

    codes: Tensor
    low: Float[Tensor, " C"]
    step: Float[Tensor, " C"]
    bits: Bits

    @property
    def bound(self) -> Float[Tensor, " C"]:
        """The largest error in each channel, before rounding to the tensor's dtype."""
        return self.step / 2


def quantise(values: Float[Tensor, "..."], bits: Bits) -> Levels:
    """Quantise to the nearest levels.

    Raises:
        ValueError: a value is not finite.
    """
    if not torch.isfinite(values).all():
        raise ValueError("values that are not finite cannot be quantised")
    exact = values.detach().cpu().to(torch.float64)
    channels = exact.reshape(-1, exact.shape[-1]) if exact.dim() > 1 else exact.reshape(-1, 1)
    if channels.numel() == 0:
        low = step = torch.zeros(channels.shape[1], dtype=torch.float64)
        return Levels(exact.to(torch.int32), low, step, bits)
    low, high = channels.amin(0), channels.amax(0)
    step = (high - low) / (2**bits - 1)
    codes = ((channels - low) / torch.where(step > 0, step, 1.0)).round()
    return Levels(codes.clamp(0, 2**bits - 1).to(torch.int32).reshape(exact.shape), low, step, bits)


def restore(levels: Levels, dtype: torch.dtype) -> Tensor:
    """The values of quantised levels."""
    codes = levels.codes.to(torch.float64)
    if codes.dim() > 1:
        return (levels.low + levels.step * codes).to(dtype)
    return (levels.low[:1] + levels.step[:1] * codes.reshape(-1)).reshape(codes.shape).to(dtype)
