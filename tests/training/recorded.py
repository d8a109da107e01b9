"""The store of a clip whose pixels are in memory."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from hoigs.core.values.clip import FrameStore


class Recorded(FrameStore):
    """Images, and masks by entity; no depth."""

    def __init__(
        self, images: list[Tensor], masks: Mapping[str, list[Tensor]] | None = None
    ) -> None:
        self.images, self.masks = images, masks or {}

    def image(self, position: int) -> Tensor:
        return self.images[position]

    def mask(self, entity: str, position: int) -> Tensor:
        return self.masks[entity][position]

    def depth(self, position: int) -> Tensor | None:
        del position
        return None
