"""Decoder: what was drawn of the Gaussians in, the picture out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import Moment


class Decoder(Configurable, nn.Module, ABC):
    """Makes the picture from what the rasterizer drew: `decoder: {use: "decoder:..."}` in a spec.

    Deformations give Gaussians `channels`, which are drawn as colours are. The model calls the
    decoder for every picture, in training, evaluation, films and the viewer: of all entities, of
    some, and of a part of the image, whose camera is then that of the part.

    Attributes:
        channels: F, of the Gaussians; those of entities that have none count as zeros. 0 if the
            decoder reads colours, depth and alpha alone. May be set on the instance.
        rates: as DeformationModel.rates.
    """

    channels: int = 0
    rates: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def forward(
        self, drawn: RenderOutput, camera: Camera, moment: Moment
    ) -> Float[Tensor, "H W 3"]:
        """The picture: RGB over the background that `drawn.color` has, not clamped.

        Where nothing was drawn (`drawn.alpha` is 0) it is the background still.

        Args:
            drawn: colour over the background, alpha, depth; `features` [H, W, F] are the channels,
                accumulated, sum(w f), or None if `channels` is 0.
            moment: as components get it: its time may be a 0-d tensor on the device.
        """
