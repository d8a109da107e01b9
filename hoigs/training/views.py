"""TrainingView: a frame as a training step needs it, and TrainingViews: those of a clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from hoigs.core.values.clip import Clip, Frame
from hoigs.training.losses import Crop, crop_around

DEVICE_SHARE = 0.25  # of a CUDA device's free memory when training starts, for views


@dataclass(frozen=True)
class TrainingView:
    """One frame with its pixels on a device.

    Attributes:
        frame: its moment stays on the CPU, from where CUDA graphs copy it.
        crops: around each person and object that is visible.
    """

    frame: Frame
    crops: Mapping[str, Crop]

    @staticmethod
    def of(frame: Frame, device: torch.device | str) -> TrainingView:
        """The view of a frame that is on the CPU."""
        placed = frame.to(device)
        # kernels read an image's bytes row by row
        placed = replace(placed, image=placed.image.contiguous(), moment=frame.moment)
        found = {name: crop_around(frame, name, placed) for name in frame.masks}
        return TrainingView(placed, {name: crop for name, crop in found.items() if crop})

    def nbytes(self) -> int:
        """Of its pixels."""
        frame = self.frame
        tensors = [frame.image, *frame.masks.values(), *(c.ignore for c in self.crops.values())]
        tensors += [t for t in (frame.depth, frame.ignored) if t is not None]
        return sum(t.untyped_storage().nbytes() for t in tensors)


class TrainingViews:
    """The views of a clip by position, made on access.

    On CUDA they stay on the device, as many as a quarter of its free memory holds: to read, decode
    and copy a frame takes longer than a step. On the CPU the clip's store keeps what it decodes.
    """

    def __init__(self, clip: Clip, device: torch.device) -> None:
        self.clip, self.device = clip, device
        self._kept: dict[int, TrainingView] = {}
        self._room = 0
        if device.type == "cuda":
            self._room = int(DEVICE_SHARE * torch.cuda.mem_get_info(device)[0])

    def __getitem__(self, position: int) -> TrainingView:
        found = self._kept.get(position)
        if found is None:
            found = TrainingView.of(self.clip[position], self.device)
            size = found.nbytes()
            if size <= self._room:
                self._kept[position] = found
                self._room -= size
        return found
