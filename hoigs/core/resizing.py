"""Modules whose parameters change their size in training, and checkpoints of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor, nn


class Resizing(nn.Module):
    """A module whose parameters take the stored size before a checkpoint is loaded.

    Attributes:
        resizes: name of a parameter or buffer of this module to the axis along which it may grow
            or shrink; any other difference of shape stays an error.
    """

    resizes: ClassVar[Mapping[str, int]] = {}

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name, axis in self.resizes.items():
            stored, own = state_dict.get(prefix + name), getattr(self, name, None)
            if stored is None or own is None or stored.dim() != own.dim():
                continue
            shape = list(own.shape)
            shape[axis] = stored.shape[axis]
            if isinstance(own, nn.Parameter):
                own.grad = None
                own.data = own.data.new_zeros(shape)
            else:
                setattr(self, name, own.new_zeros(shape))
        super()._load_from_state_dict(state_dict, prefix, *rest)
