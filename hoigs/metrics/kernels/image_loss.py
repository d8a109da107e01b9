# mypy: ignore-errors
# (Warp's arrays annotate as values)
"""Image losses by Warp kernels as one differentiable function of torch tensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int32, UInt8
from torch import Tensor

from hoigs.core.fast.cuda_launch import CudaStreams
from hoigs.core.fast.launch import CPU_FLAGS, prepared
from hoigs.core.first_order import first_order
from hoigs.core.system.quiet_warp import wp
from hoigs.metrics.kernels.tiles import SIDE, THREADS, backward, forward
from hoigs.rasterizers.warp.records import F32, I32, U8

# C++ of the image loss's kernels; the stages are those of SSIM (`warp.ssim.tile_source`).
#
# Lines of render, frame, masks and gradient are `stride` numbers apart, since all are boxes of
# larger images; arrays begin at the box's first pixel, or, `boxed`, at that of the whole image, and
# the box is read from the device. Where a pixel is ignored the render is replaced by the target, so
# that it has neither a loss nor a gradient.

_BOX = """
    int top_ = 0, left_ = 0;
    if (boxed) {
        const int* found = (const int*)box.data;
        top_ = found[0]; left_ = found[1]; height = found[2]; width = found[3];
        if (height * width == 0) return;
        l1_weight /= 3.0f * (boxed > 1 ? (float)found[4] : (float)height * (float)width);
    }
"""
_INSIDE = "    if (tile / tiles_x >= tiles_y) return;  // the box is smaller than the image\n"
_FETCH = """
            const long long at = (long long)(y + top_) * render_stride + (x + left_) * channels
                                 + channel;
            const long long masked = (long long)(y + top_) * mask_stride + x + left_;
            b = ((const unsigned char*)pixels.data)[(long long)(y + top_) * pixel_stride
                                                    + (x + left_) * channels + channel] / 255.0f;
            if (with_shown && !((const unsigned char*)shown.data)[masked])
                b = ((const float*)background.data)[channel];
            const bool hidden = with_ignored && ((const unsigned char*)ignored.data)[masked];
            a = hidden ? b : ((const float*)render.data)[at];
"""
# in[1] holds image - target of the tile and 5 pixels around it
_PIXEL = """
            const float difference = in[1][top + j + 5][c + 5];
            sum += l1_weight * fabsf(difference) + dssim_weight / (float)numbers * (1.0f - value);
"""
_GRADIENT = """
            const float sign = a > b ? 1.0f : (a < b ? -1.0f : 0.0f);
            float value = l1_weight * sign - dssim_weight / (float)numbers * slope;
            value = hidden ? 0.0f : scale * value;
            float* into = (float*)gradient.data + (long long)(y + top_) * gradient_stride
                          + (x + left_) * channels + channel;
            *into = add ? *into + value : value;
"""
FORWARD = forward(_FETCH, _PIXEL, _BOX, _INSIDE)
BACKWARD = backward(_FETCH, _GRADIENT, _BOX, _INSIDE)


# The CUDA kernels of the image loss; their loops stand in `source`.
#
# Threads are numbered as in `warp.ssim.tile_kernels`. One image of three channels: batch is 1.

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})
BLOCK = wp.constant(THREADS)


@wp.func_native(FORWARD)
def forward_native(
    thread: int, batch: int, height: int, width: int, channels: int,
    render: F32, render_stride: int, pixels: U8, pixel_stride: int, shown: U8, ignored: U8,
    mask_stride: int, with_shown: int, with_ignored: int, background: F32, l1_weight: float,
    dssim_weight: float, box: I32, boxed: int, with_gradient: int, sums: F32, kept: F32,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def forward_tiles(
    height: int, width: int,
    render: F32, render_stride: int,  # floats from line to line
    pixels: U8, pixel_stride: int,  # of the frame, bytes
    shown: U8,  # 0 where the target is the background; not read unless with_shown
    ignored: U8, mask_stride: int, with_shown: int, with_ignored: int,
    background: F32,  # [3]
    l1_weight: float, dssim_weight: float,
    box: I32,  # [5] top, left, height, width, area; not read unless boxed
    boxed: int,  # 1 divides L1 by three times the pixels of the box, 2 by three times the area
    with_gradient: int,
    sums: F32,  # [tiles] of the weighted loss
    kept: F32,  # [3, 3, height, width], or empty: to blur
):  # fmt: skip
    forward_native(
        wp.tid(), 1, height, width, 3, render, render_stride, pixels, pixel_stride, shown, ignored,
        mask_stride, with_shown, with_ignored, background, l1_weight, dssim_weight, box, boxed,
        with_gradient, sums, kept,
    )  # fmt: skip


@wp.func_native(BACKWARD)
def backward_native(
    thread: int, batch: int, height: int, width: int, channels: int,
    render: F32, render_stride: int, pixels: U8, pixel_stride: int, shown: U8, ignored: U8,
    mask_stride: int, with_shown: int, with_ignored: int, background: F32, l1_weight: float,
    dssim_weight: float, box: I32, boxed: int, kept: F32, upstream: F32, gradient: F32,
    gradient_stride: int, add: int,
): ...  # fmt: skip


@wp.kernel(launch_bounds=BLOCK)
def backward_tiles(
    height: int, width: int,
    render: F32, render_stride: int, pixels: U8, pixel_stride: int, shown: U8, ignored: U8,
    mask_stride: int, with_shown: int, with_ignored: int, background: F32,
    l1_weight: float, dssim_weight: float, box: I32, boxed: int, kept: F32,
    upstream: F32,  # [1]
    gradient: F32, gradient_stride: int,
    add: int,  # 0 writes the gradient, 1 adds to what stands there
):  # fmt: skip
    backward_native(
        wp.tid(), 1, height, width, 3, render, render_stride, pixels, pixel_stride, shown, ignored,
        mask_stride, with_shown, with_ignored, background, l1_weight, dssim_weight, box, boxed,
        kept, upstream, gradient, gradient_stride, add,
    )  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What a box of a render is compared with, and how.

    All tensors may be views of larger images, on the render's device.

    Attributes:
        pixels: of the frame. shown: pixels that show what is compared; elsewhere the target is the
            background; None where all do. ignored: pixels without a loss, or None.
        background: RGB in [0, 1]; needed where `shown` is not None.
        top, left: of the box in the render, pixels.
        l1: weight of the sum of absolute differences over the box; with `box`, of that sum over
            three times the area there, or over the numbers of the box where `by_area` is False.
        dssim: weight of 1 - SSIM, which is a mean over the box.
        box: top, left, height, width and area of a box of `pixels`, masks and render, which are
            whole images then, on the device, from where a CUDA graph reads them anew. An empty box
            has no loss.
    """

    pixels: UInt8[Tensor, "h w 3"]
    l1: float
    dssim: float
    shown: Bool[Tensor, "h w"] | None = None
    ignored: Bool[Tensor, "h w"] | None = None
    background: Float[Tensor, "3"] | None = None
    top: int = 0
    left: int = 0
    box: Int32[Tensor, "5"] | None = None
    by_area: bool = True


def image_losses(
    render: Float[Tensor, "H W 3"], targets: Sequence[Target]
) -> Float[Tensor, " targets"]:
    """The loss of a float32 render against each target, by the kernels of CUDA.

    Differentiable once, in the render. Two runs agree bit for bit. On a CPU the kernels run as
    scalar code, which serves tests.
    """
    return _ImageLosses.apply(render.contiguous(), tuple(targets))


class _ImageLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, render: Tensor, targets: tuple[Target, ...]) -> Tensor:
        tracked = ctx.needs_input_grad[0]
        most = max(_tiles(t.pixels) for t in targets)
        sums = render.new_zeros(len(targets), most)
        kept = []
        with torch.cuda.device_of(render):
            for target, row in zip(targets, sums):
                own = render.new_empty(3 * target.pixels.numel() if tracked else 0)
                _launch(forward_tiles, target, render, [int(tracked), row, own])
                kept.append(own)
        ctx.targets = targets
        ctx.save_for_backward(render, *kept)
        return sums.sum(1)

    @staticmethod
    @first_order("image_losses", "train.loss.ssim: torch has the second, too")
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        render, *kept = ctx.saved_tensors
        first = ctx.targets[0]
        whole = first.pixels.shape == render.shape and first.box is None
        gradient = torch.empty_like(render) if whole else torch.zeros_like(render)
        given = upstream[0].contiguous()
        with torch.cuda.device_of(render):
            for index, target in enumerate(ctx.targets):
                box = gradient[target.top :, target.left :]
                rest = [kept[index], given[index:], box, gradient.stride(0), int(index > 0)]
                _launch(backward_tiles, target, render, rest)
        return gradient, None


_STREAMS = CudaStreams()


def _launch(kernel: Any, target: Target, render: Tensor, rest: list[Any]) -> None:
    pixels = target.pixels
    height, width = pixels.shape[:2]
    if pixels.stride()[1:] != (3, 1):
        raise ValueError(f"pixels are rows of RGB bytes, got strides {pixels.stride()}")
    masks = [m for m in (target.shown, target.ignored) if m is not None]
    strides = {mask.stride() for mask in masks}
    if len(strides) > 1 or any(stride[1] != 1 for stride in strides):
        raise ValueError(f"masks are boxes of images of one width, got strides {sorted(strides)}")
    shown, ignored = (
        # not read where there is none
        pixels if mask is None else mask.view(torch.uint8)
        for mask in (target.shown, target.ignored)
    )
    arguments = [
        height, width, render[target.top :, target.left :], render.stride(0),
        pixels, pixels.stride(0), shown, ignored, masks[0].stride(0) if masks else 0,
        int(target.shown is not None), int(target.ignored is not None),
        render if target.background is None else target.background,
        target.l1, target.dssim, render if target.box is None else target.box,
        0 if target.box is None else 1 + int(target.by_area), *rest,
    ]  # fmt: skip
    if render.is_cuda:
        _STREAMS.current().blocks(kernel, _tiles(pixels), THREADS, arguments)
    else:
        prepared(kernel, _tiles(pixels), arguments).launch()


def _tiles(pixels: Tensor) -> int:
    height, width, channels = pixels.shape
    return channels * -(-height // SIDE) * -(-width // SIDE)
