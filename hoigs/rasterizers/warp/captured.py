"""A render as a CUDA graph: drawn again and again without Python or launches in between."""

from __future__ import annotations

from typing import Any

import torch

from hoigs.core.camera import Camera
from hoigs.core.capture import capturing
from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import RenderOutput, RenderRequest
from hoigs.rasterizers.warp.frame import Inputs


class CapturedRender:
    """Draws as `WarpRasterizer.render` does, without gradients; made by `WarpRasterizer.capture`.

    New values are copied into buffers of its own and the graph is replayed on torch's current
    stream. The output is the graph's own memory too: the next call draws over it.

    Should a view have so many splats in tiles that there is no room for, it is still drawn right,
    only slower (see `lists`); the next call then captures anew, with more room.

    Attributes:
        captures: how often the graph was captured, 1 as long as there was room.
    """

    def __init__(
        self, rasterizer: Any, gaussians: Gaussians, camera: Camera, request: RenderRequest
    ) -> None:
        self._rasterizer = rasterizer
        self._settings, tensors = rasterizer.door.prepare(rasterizer, gaussians, camera, request)
        self._buffers = [x.detach().clone() for x in tensors]
        self._path = rasterizer.path(gaussians.means.device)
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
            gaussians: as many Gaussians, with as many SH bands, as were captured.
            request: other tensors of the same shapes; the numbers must be those captured.

        Returns:
            the images, valid until the next call: clone what is to be kept.

        Raises:
            RenderError: a size or a number differs from what was captured.
        """
        if self._path.lists.room.outgrown(self._room):
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
        settings, tensors = self._rasterizer.door.prepare(
            self._rasterizer, gaussians, camera, request
        )
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
                "background, world_to_camera, K, subset); capture another one"
            )
        given = [gaussians is not self._gaussians] * 5
        given += [request is not self._request] * 3
        given += [camera is not self._camera] * 2 + [request is not self._request]
        with torch.no_grad():
            for buffer, tensor, new in zip(self._buffers, tensors, given):
                if new:
                    buffer.copy_(tensor)
        self._camera, self._gaussians, self._request = camera, gaussians, request

    def _capture(self) -> None:
        device = self._buffers[0].device
        self._graph = torch.cuda.CUDAGraph()
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.no_grad(), torch.cuda.device(device):
            with torch.cuda.stream(side):  # kernels are compiled, and pairs counted
                self._draw()
            with capturing(self._graph, side):
                self._output, self._room = self._draw()
        torch.cuda.current_stream(device).wait_stream(side)
        self.captures += 1

    def _draw(self) -> tuple[RenderOutput, int]:
        """The picture, and for how many pairs there was room."""
        inputs = Inputs(*self._buffers)
        projected = self._path.project(inputs, self._settings)
        lists = self._path.bin(projected, self._settings)
        images = self._path.composite(inputs, self._settings, projected.records, lists)
        info = {
            "radii": projected.radii,
            "means2d": projected.means2d,
            "depths": projected.depths,
        }
        extra = None if self._request.features is None else images.extra
        output = RenderOutput(images.color, images.alpha, images.depth, extra, info)
        return output, lists.pairs.shape[0]
