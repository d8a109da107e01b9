"""What the kernels are given and write; shared by every path.

The lists of arguments hold what `array` makes of each tensor: a descriptor of Warp's unless told
otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.calls import flat
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings
from hoigs.rasterizers.warp.records import POSE, RECORD, SMALLEST_ALPHA

Array = Callable[..., Any]  # (tensor, size of its vectors = 1)


class Projected:
    """What `projection.project` writes.

    Attributes:
        records: [N, RECORD], see `records`.
        means2d: [N, 2] pixels. depths: [N] metres. radii: [N] pixels; all 0 when culled.
        drawn_depths: [N] metres, negative where nothing is drawn.
    """

    def __init__(self, like: Tensor, count: int) -> None:
        self.records = like.new_empty(count, RECORD)
        self.means2d = like.new_empty(count, 2)
        self.depths = like.new_empty(count)
        self.drawn_depths = like.new_empty(count)
        self.radii = like.new_empty(count)


def project_arguments(
    inputs: Inputs, settings: Settings, out: Projected, array: Array = flat
) -> list[Any]:
    """Arguments of `projection.project` but for its last two, the range of rows."""
    return [
        array(inputs.means, 3),
        array(inputs.quats, 4),
        array(inputs.log_scales, 3),
        array(inputs.opacity_logits),
        array(inputs.sh, 3),
        inputs.sh.shape[1],
        settings.bands,
        array(inputs.features),
        inputs.channels,
        array(inputs.offsets),
        int(inputs.offsets.numel() > 0),
        array(inputs.subset),
        int(inputs.subset.numel() > 0),
        array(inputs.K),
        array(inputs.view),
        settings.width,
        settings.height,
        settings.near,
        settings.low_pass,
        settings.min_alpha,
        max(settings.min_alpha, SMALLEST_ALPHA),
        array(out.records),
        array(out.means2d),
        array(out.depths),
        array(out.drawn_depths),
        array(out.radii),
    ]


class Gradients:
    """What `projection.project_adjoint` writes, in the shapes of the inputs."""

    def __init__(self, inputs: Inputs, pose: bool) -> None:
        self.means = torch.empty_like(inputs.means)
        self.quats = torch.empty_like(inputs.quats)
        self.log_scales = torch.empty_like(inputs.log_scales)
        self.opacity_logits = torch.empty_like(inputs.opacity_logits)
        self.sh = torch.empty_like(inputs.sh)
        self.features = torch.empty_like(inputs.features) if inputs.channels else inputs.features
        self.offsets = inputs.means.new_empty(inputs.count, 2)
        self.pose = inputs.means.new_empty(inputs.count if pose else 0, POSE)

    def view(self, inputs: Inputs) -> Tensor:
        """Gradient of world_to_camera [4, 4] from the rows of `pose`.

        The camera centre is -R^T t, so its gradient v adds -t v^T to that of R and -R v to that
        of t.
        """
        total = self.pose.sum(0)
        result = torch.zeros_like(inputs.view)
        rotation, shift = inputs.view[:3, :3], inputs.view[:3, 3]
        center = total[12:]
        result[:3, :3] = total[:9].view(3, 3) - torch.outer(shift, center)
        result[:3, 3] = total[9:12] - rotation @ center
        return result


def adjoint_arguments(
    inputs: Inputs,
    settings: Settings,
    records: Tensor,
    lists: Lists,
    partials: Tensor,
    out: Gradients,
    array: Array = flat,
) -> list[Any]:
    """Arguments of `projection.project_adjoint` but for its last two, the range of rows."""
    return [
        array(inputs.means, 3),
        array(inputs.quats, 4),
        array(inputs.log_scales, 3),
        array(inputs.opacity_logits),
        array(inputs.sh, 3),
        inputs.sh.shape[1],
        settings.bands,
        inputs.channels,
        array(inputs.offsets),
        int(inputs.offsets.numel() > 0),
        array(inputs.K),
        array(inputs.view),
        settings.width,
        settings.height,
        settings.low_pass,
        array(records),
        array(lists.first),
        array(lists.slots),
        array(partials),
        array(out.means, 3),
        array(out.quats, 4),
        array(out.log_scales, 3),
        array(out.opacity_logits),
        array(out.sh, 3),
        array(out.offsets),
        array(out.features),
        array(out.pose),
        int(out.pose.numel() > 0),
    ]


def tile_arguments(
    inputs: Inputs,
    settings: Settings,
    records: Tensor,
    lists: Lists,
    images: Images,
    array: Array = flat,
) -> list[Any]:
    """Arguments that the tile kernels of all paths have in common, forward."""
    return [
        lists.tiles,
        lists.across,
        settings.width,
        settings.height,
        settings.max_alpha,
        math.log2(max(settings.min_alpha, SMALLEST_ALPHA)),
        settings.min_transmittance if settings.min_transmittance > 0 else -1.0,
        array(records),
        array(lists.pairs),
        array(lists.offsets),
        array(inputs.features),
        inputs.channels,
        array(inputs.background),
        3 if inputs.background.dim() == 3 else 0,
        array(images.color),
        array(images.alpha),
        array(images.depth),
        array(images.extra),
    ]


def upstream_arguments(upstream: Images, partials: Tensor, array: Array = flat) -> list[Any]:
    """What the backward tile kernels take besides: gradients of the images, and partials."""
    return [
        array(upstream.color),
        array(upstream.alpha),
        array(upstream.depth),
        array(upstream.extra),
        array(partials),
    ]
