"""WarpRasterizer: EWA splatting with Warp kernels, on CPUs and on CUDA."""

from __future__ import annotations

from typing import Any, Literal

import torch
from pydantic import Field

from hoigs.core.camera import Camera
from hoigs.core.config import ComponentConfig
from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Capabilities, Rasterizer, RenderOutput, RenderRequest
from hoigs.rasterizers.warp.autograd import Render
from hoigs.rasterizers.warp.captured import CapturedRender
from hoigs.rasterizers.warp.inputs import Door


class WarpConfig(ComponentConfig):
    """Settings of WarpRasterizer; see there."""

    cpu_kernels: Literal["auto", "native", "portable"] = Field(
        "auto",
        description="native are fast, portable those of CUDA; auto: native where they compile",
    )
    scheduler: Literal["threads", "openmp", "auto", "serial"] = Field(
        "threads", description="how CPU work is spread over cores; serial is the calling thread"
    )
    threads: int | None = Field(
        None, description="CPU cores to use; torch.get_num_threads() if None"
    )


class WarpRasterizer(Rasterizer):
    """Draws by the rules of `hoigs.core.projection`, in float32, with a hand-written backward.

    The first render on a machine compiles its kernels (some seconds) into Warp's cache
    (`WARP_CACHE_PATH`); later processes load them in milliseconds. Two renders of the same input
    agree bit for bit, whatever the scheduler and the number of threads.

    On CUDA everything happens on torch's current stream, and nothing waits for the device but a
    render with more Gaussians or more pixels than any before it on this rasterizer, for its number
    of splats in tiles ("pairs"). Later renders make room for 1.5 times the most pairs seen. A view
    that has more is still drawn right, with the same picture, but some times slower, and its
    gradients then sum in no fixed order; the next one finds more room. A render holds 20 bytes a
    pair of room (12 of them shared by all renders of a stream), its backward 4 (10 + feature
    channels) more, and 92 bytes a Gaussian, gradients apart. Steps can be captured in a CUDA graph
    after a first one; `capture` does that for rendering.

    Args:
        cpu_kernels: "native", the fast ones; "portable", the very kernels that CUDA runs, as scalar
            code (about ten times slower; also for testing them without a GPU); "auto", native where
            they compile, else portable with a warning.
        scheduler: how CPU work is spread over cores. "threads": Python threads. "openmp": torch's
            own pool, 5 to 15 % faster where nothing else runs (more for small images) and slower
            where the cores are shared, since its workers wait by spinning; it reaches into private
            parts of Warp, checked by a trial. "auto": openmp where the trial passes, else threads.
            "serial": the calling thread. What runs, and why, stands in `backend_report()`.
        threads: CPU cores to use; torch.get_num_threads() when None.

    Raises:
        RenderError: Warp is not installed, or the kernels or the scheduler asked for cannot be used
            here.
    """

    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32"}),
        camera_gradients=True,
        deterministic=True,
    )

    def __init__(
        self,
        cpu_kernels: Literal["auto", "native", "portable"] = "auto",
        scheduler: Literal["threads", "openmp", "auto", "serial"] = "threads",
        threads: int | None = None,
    ) -> None:
        if threads is not None and threads < 1:
            raise RenderError(f"WarpRasterizer: threads is {threads}, expected at least 1")
        self.cpu_kernels, self.scheduler, self.threads = cpu_kernels, scheduler, threads
        self.door = Door()
        self._paths: dict[torch.device, Any] = {}
        self._report: dict[str, str] = {}

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        request = request or RenderRequest()
        settings, tensors = self.door.prepare(self, gaussians, camera, request)
        path = self.path(gaussians.means.device)
        color, alpha, depth, extra, means2d, depths, radii = Render.apply(path, settings, *tensors)
        info = {"radii": radii, "means2d": means2d, "depths": depths}
        return RenderOutput(color, alpha, depth, None if request.features is None else extra, info)

    def capture(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> CapturedRender:
        """Record a render on CUDA as a graph, to draw many views or moments with little delay.

            draw = rasterizer.capture(gaussians, camera)
            for view in views:
                image = draw(camera=view).color  # valid until the next call

        Sizes, SH bands and the numbers of the request are fixed; see CapturedRender. Without
        gradients.

        Raises:
            RenderError: the Gaussians are not on CUDA, or cannot be drawn.
        """
        if gaussians.means.device.type != "cuda":
            raise RenderError(
                f"WarpRasterizer.capture: Gaussians are on {gaussians.means.device}, expected a "
                "CUDA device: CUDA graphs are there alone; use render, or move them with .to(...)"
            )
        return CapturedRender(self, gaussians, camera, request or RenderRequest())

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the settings; they bring up their own kernels."""
        return type(self), (self.cpu_kernels, self.scheduler, self.threads)

    def backend_report(self) -> dict[str, str]:
        """What runs the kernels and why, for `hoigs doctor` and run provenance."""
        self.path(torch.device("cpu"))
        return dict(self._report)

    def path(self, device: torch.device) -> Any:
        """What draws on a device: its kernels, brought up once."""
        if device not in self._paths:
            if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
                raise RenderError(
                    "WarpRasterizer: its first render must not be captured in a CUDA graph: render "
                    "once before the capture, backward included if that is captured too"
                )
            self._paths[device] = self._make_path(device)
        return self._paths[device]

    def _make_path(self, device: torch.device) -> Any:
        try:
            import warp
        except ImportError as error:
            raise RenderError(
                "WarpRasterizer needs Warp, which is not installed: pip install warp-lang"
            ) from error
        if device.type == "cuda":
            from hoigs.rasterizers.warp.cuda import CudaPath

            self._report |= {"warp": warp.config.version, "cuda": "pixel kernels"}
            return CudaPath(device)
        from hoigs.rasterizers.warp.capability import choose_kernels
        from hoigs.rasterizers.warp.launchers import Cores
        from hoigs.rasterizers.warp.workers import make_workers

        kernels, why = choose_kernels(self.cpu_kernels)
        workers, reason = make_workers(self.scheduler)
        self._report |= {
            "warp": warp.config.version,
            "cpu_kernels": kernels,
            "cpu_kernels_reason": why,
            "scheduler": workers.name,
            "scheduler_reason": reason,
        }
        cores = Cores(workers, self.threads)
        if kernels == "portable":
            from hoigs.rasterizers.warp.pixels import PixelPath

            return PixelPath(cores)
        from hoigs.rasterizers.warp.cpu import NativePath

        return NativePath(cores)
