"""A render as a CUDA graph: drawn again and again without Python or launches in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.fast.graphs import capturing
from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.warp.autograd import draw
from hoigs.rasterizers.warp.frame import Inputs, Settings

Prepare = Callable[[Gaussians, Camera, RenderRequest], tuple[Settings, list[Tensor]]]


class CapturedRender:
    """Draws as `WarpRasterizer.render` does, without gradients; made by `WarpRasterizer.capture`.

    New values are copied into buffers of its own, and the graph is replayed on torch's current
    stream. The output is the graph's own memory too: the next call draws over it.

    A view with more tile intersections than the captured memory holds is still drawn right, only
    slower (see `cuda.intersections`); the next call then captures again, with more memory.

    Args:
        pipeline: the stages on the device. prepare: makes settings and tensors from values.

    Attributes:
        captures: how often the graph was captured; 1 while the memory suffices.
    """

    def __init__(
        self,
        pipeline: Any,
        prepare: Prepare,
        gaussians: Gaussians,
        camera: Camera,
        request: RenderRequest,
    ) -> None:
        self._pipeline, self._prepare = pipeline, prepare
        self._settings, tensors = prepare(gaussians, camera, request)
        self._buffers = [x.detach().clone() for x in tensors]
        self._gaussians, self._camera, self._request = gaussians, camera, request
        self.captures = 0
        self._capture()

    def __call__(
        self,
        camera: Camera | None = None,
        gaussians: Gaussians | None = None,
        request: RenderRequest | None = None,
    ) -> RenderOutput:
        """Draw; what is not given stays as it was in the last call.

        Args:
            camera: another view of the same size.
            gaussians: as many Gaussians, with as many SH bases, as were captured.
            request: other tensors of the same shapes; the numbers must be those captured.

        Returns:
            the images, valid until the next call: clone what is to be kept.

        Raises:
            RenderError: a size or a number differs from what was captured.
        """
        if self._pipeline.capacity.exceeded(self._capacity):
            self._capture()
        if not (camera is None and gaussians is None and request is None):
            self._update(camera, gaussians, request)
        self._graph.replay()
        return self._output

    def _update(
        self, camera: Camera | None, gaussians: Gaussians | None, request: RenderRequest | None
    ) -> None:
        camera, gaussians = camera or self._camera, gaussians or self._gaussians
        request = request or self._request
        settings, tensors = self._prepare(gaussians, camera, request)
        if settings != self._settings:
            raise RenderError(
                f"CapturedRender: captured with {self._settings}, called with {settings}; "
                "capture another one"
            )
        shapes = [tuple(x.shape) for x in tensors]
        captured = [tuple(x.shape) for x in self._buffers]
        if shapes != captured:
            raise RenderError(
                f"CapturedRender: captured with tensors of shapes {captured}, called with {shapes} "
                "(means, quats, log_scales, opacity_logits, sh, features, screen_offsets, "
                "background, world_to_camera, K, subset, absolute_gradients); capture another one"
            )
        changed = [gaussians is not self._gaussians] * 5
        changed += [request is not self._request] * 3
        changed += [camera is not self._camera] * 2 + [request is not self._request] * 2
        with torch.no_grad():
            for buffer, tensor, new in zip(self._buffers, tensors, changed):
                if new:
                    buffer.copy_(tensor)
        self._camera, self._gaussians, self._request = camera, gaussians, request

    def _capture(self) -> None:
        device = self._buffers[0].device
        self._graph = torch.cuda.CUDAGraph()
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.no_grad(), torch.cuda.device(device):
            with torch.cuda.stream(side):  # compiles kernels and counts intersections
                self._draw()
            with capturing(self._graph, side):
                self._output, self._capacity = self._draw()
        torch.cuda.current_stream(device).wait_stream(side)
        self.captures += 1

    def _draw(self) -> tuple[RenderOutput, int]:
        """The output, and for how many intersections there was memory."""
        projected, tiles, images = draw(self._pipeline, self._settings, Inputs(*self._buffers))
        info = {name: getattr(projected, name) for name in ("radii", "means2d", "depths")}
        features = None if self._request.features is None else images.features
        return RenderOutput(images.color, images.alpha, images.depth, features, info), tiles.count
