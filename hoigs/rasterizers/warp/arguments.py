"""What the projection and the tile kernels are given and write, on every device."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from hoigs.rasterizers.warp.frame import MOTION, Images, Inputs, Settings, TileIntersections
from hoigs.rasterizers.warp.records import ABSOLUTES, POSE, RECORD, SMALLEST_ALPHA

# What the projection kernels are given and write, on every device.


class Projected:
    """What `kernels.project` writes.

    Attributes:
        records: [N, RECORD], see `common.records`.
        means2d: [N, 2] pixels. depths: [N] metres. radii: [N] pixels; all 0 when culled.
        drawn_depths: [N] metres, negative where nothing is drawn.
    """

    def __init__(self, like: Tensor, count: int) -> None:
        self.records = like.new_empty(count, RECORD)
        # one allocation, since the first kernel waits for it
        numbers = like.new_empty(5 * count).split([2 * count, count, count, count])
        means2d, self.depths, self.drawn_depths, self.radii = numbers
        self.means2d = means2d.view(count, 2)


def project_arguments(inputs: Inputs, settings: Settings, out: Projected) -> list[Any]:
    """Arguments of `kernels.project` but for its last two, the range of Gaussians."""
    return [
        *(inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits, inputs.sh),
        *(inputs.sh.shape[1], settings.active_bases),
        *(inputs.features, inputs.channels),
        *(inputs.screen_offsets, int(inputs.screen_offsets.numel() > 0)),
        *(inputs.subset, int(inputs.subset.numel() > 0)),
        *(inputs.K, inputs.world_to_camera, settings.width, settings.height),
        *(settings.near, settings.low_pass, int(settings.antialiased), settings.min_alpha),
        max(settings.min_alpha, SMALLEST_ALPHA),
        *(out.records, out.means2d, out.depths, out.drawn_depths, out.radii),
    ]


class Gradients:
    """What `kernels.project_adjoint` writes, in the shapes of the inputs.

    Args:
        pose, absolute, offsets: whether these are asked for; else theirs are empty.
        optics: whether the camera has some.

    Attributes:
        sh: the largest, and the last that is written; the pipelines say where.
    """

    sh: Tensor

    def __init__(
        self, inputs: Inputs, pose: bool, absolute: bool, offsets: bool, optics: bool
    ) -> None:
        self.means = torch.empty_like(inputs.means)
        self.quats = torch.empty_like(inputs.quats)
        self.log_scales = torch.empty_like(inputs.log_scales)
        self.opacity_logits = torch.empty_like(inputs.opacity_logits)
        self.features = torch.empty_like(inputs.features) if inputs.channels else inputs.features
        self.screen_offsets = inputs.means.new_empty(inputs.count if offsets else 0, 2)
        self.absolutes = inputs.means.new_empty(inputs.count if absolute else 0, ABSOLUTES)
        self.pose = inputs.means.new_empty(inputs.count if pose else 0, POSE)
        self.all_poses, self.motion = self.pose, None
        if optics and pose:  # rows of the motion follow those of the poses
            split = inputs.count * POSE
            self.all_poses = inputs.means.new_zeros(split + inputs.count * MOTION)
            self.pose = self.all_poses[:split].view(-1, POSE)
            self.motion = self.all_poses[split:].view(-1, MOTION)

    def world_to_camera(self, inputs: Inputs) -> Tensor:
        """Gradient of world_to_camera [4, 4] from the rows of `pose`.

        The camera centre is -R^T t, so its gradient v adds -t v^T to that of R and -R v to that
        of t.
        """
        total = self.pose.sum(0)
        result = torch.zeros_like(inputs.world_to_camera)
        rotation, translation = inputs.world_to_camera[:3, :3], inputs.world_to_camera[:3, 3]
        center = total[12:]
        result[:3, :3] = total[:9].view(3, 3) - torch.outer(translation, center)
        result[:3, 3] = total[9:12] - rotation @ center
        return result

    def camera_numbers(self, inputs: Inputs) -> Tensor | None:
        """Gradient of what stands for K with optics: of the motion, which is last."""
        if self.motion is None:
            return None
        result = torch.zeros_like(inputs.K)
        result[-MOTION:] = self.motion.sum(0)
        return result


def adjoint_arguments(
    inputs: Inputs,
    settings: Settings,
    bases: tuple[int, int],
    records: Tensor,
    partial_counts: Tensor,
    partials: tuple[Tensor, Tensor] | None,
    out: Gradients,
) -> list[Any]:
    """Arguments of `kernels.project_adjoint` but for its last two, the range of Gaussians.

    Args:
        bases: stored and active ones; none where another kernel has differentiated the colours.
        partial_counts: of each Gaussian. partials: the index of the first of each, and themselves;
            None where they have been summed (`gather_kernels`).
    """
    first_partial, numbers = partials or (partial_counts, out.means)  # these are not read
    return [
        *(inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits, inputs.sh),
        *(*bases, inputs.channels),
        *(inputs.screen_offsets, int(inputs.screen_offsets.numel() > 0)),
        *(inputs.K, inputs.world_to_camera, settings.width, settings.height),
        *(settings.low_pass, int(settings.antialiased)),
        *(records, first_partial, partial_counts, int(partials is None), numbers),
        *(out.means, out.quats, out.log_scales, out.opacity_logits, out.sh),
        *(out.screen_offsets, int(len(out.screen_offsets) > 0)),
        *(out.features, out.absolutes, ABSOLUTES * int(len(out.absolutes) > 0)),
        *(out.all_poses, len(out.pose)),
    ]


def tile_arguments(
    inputs: Inputs,
    settings: Settings,
    records: Tensor,
    intersections: TileIntersections,
    images: Images,
) -> list[Any]:
    """Arguments that the forward and backward tile kernels have in common."""
    return [
        *(intersections.tiles, intersections.tiles_x, settings.width, settings.height),
        settings.max_alpha,
        math.log2(max(settings.min_alpha, SMALLEST_ALPHA)),
        settings.min_transmittance if settings.min_transmittance > 0 else -1.0,
        *(records, intersections.indices, intersections.offsets),
        *(inputs.features, inputs.channels),
        *(inputs.background, 3 if inputs.background.dim() == 3 else 0),
        *(images.color, images.alpha, images.depth, images.features),
    ]


def upstream_arguments(upstream: Images, partials: Tensor) -> list[Any]:
    """What the backward tile kernels take besides: gradients of the images, and the partials."""
    return [upstream.color, upstream.alpha, upstream.depth, upstream.features, partials]
