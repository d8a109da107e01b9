"""What the kernels are given and write; shared by every path."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.calls import flat
from hoigs.rasterizers.warp.frame import Images, Inputs, Lists, Settings
from hoigs.rasterizers.warp.records import POSE, RECORD, SMALLEST_ALPHA


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


def project_arguments(inputs: Inputs, settings: Settings, out: Projected) -> list[Any]:
    """Arguments of `projection.project` but for its last two, the range of rows."""
    return [
        flat(inputs.means, 3),
        flat(inputs.quats, 4),
        flat(inputs.log_scales, 3),
        flat(inputs.opacity_logits),
        flat(inputs.sh, 3),
        inputs.sh.shape[1],
        settings.bands,
        flat(inputs.features),
        inputs.channels,
        flat(inputs.offsets),
        int(inputs.offsets.numel() > 0),
        flat(inputs.subset),
        int(inputs.subset.numel() > 0),
        flat(inputs.K),
        flat(inputs.view),
        settings.width,
        settings.height,
        settings.near,
        settings.low_pass,
        settings.min_alpha,
        max(settings.min_alpha, SMALLEST_ALPHA),
        flat(out.records),
        flat(out.means2d),
        flat(out.depths),
        flat(out.drawn_depths),
        flat(out.radii),
    ]


class Gradients:
    """What `projection.project_adjoint` writes, in the shapes of the inputs."""

    def __init__(self, inputs: Inputs, pose: bool) -> None:
        self.means = torch.empty_like(inputs.means)
        self.quats = torch.empty_like(inputs.quats)
        self.log_scales = torch.empty_like(inputs.log_scales)
        self.opacity_logits = torch.empty_like(inputs.opacity_logits)
        self.sh = torch.empty_like(inputs.sh)
        self.features = torch.empty_like(inputs.features)
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
) -> list[Any]:
    """Arguments of `projection.project_adjoint` but for its last two, the range of rows."""
    return [
        flat(inputs.means, 3),
        flat(inputs.quats, 4),
        flat(inputs.log_scales, 3),
        flat(inputs.opacity_logits),
        flat(inputs.sh, 3),
        inputs.sh.shape[1],
        settings.bands,
        inputs.channels,
        flat(inputs.offsets),
        int(inputs.offsets.numel() > 0),
        flat(inputs.K),
        flat(inputs.view),
        settings.width,
        settings.height,
        settings.low_pass,
        flat(records),
        flat(lists.first),
        flat(lists.slots),
        flat(partials),
        flat(out.means, 3),
        flat(out.quats, 4),
        flat(out.log_scales, 3),
        flat(out.opacity_logits),
        flat(out.sh, 3),
        flat(out.offsets),
        flat(out.features),
        flat(out.pose),
        int(out.pose.numel() > 0),
    ]


def tile_arguments(
    inputs: Inputs, settings: Settings, records: Tensor, lists: Lists, images: Images
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
        flat(records),
        flat(lists.pairs),
        flat(lists.offsets),
        flat(inputs.features),
        inputs.channels,
        flat(inputs.background),
        3 if inputs.background.dim() == 3 else 0,
        flat(images.color),
        flat(images.alpha),
        flat(images.depth),
        flat(images.extra),
    ]


def upstream_arguments(upstream: Images, partials: Tensor) -> list[Any]:
    """What the backward tile kernels take besides: gradients of the images, and partials."""
    return [
        flat(upstream.color),
        flat(upstream.alpha),
        flat(upstream.depth),
        flat(upstream.extra),
        flat(partials),
    ]
