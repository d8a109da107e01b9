"""WarpRasterizer: EWA splatting with Warp kernels, on CPUs and on CUDA."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import (
    OPTICS,
    Capabilities,
    Rasterizer,
    RenderOutput,
    RenderRequest,
)
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.warp.autograd import render
from hoigs.rasterizers.warp.frame import InputValidation
from hoigs.rasterizers.warp.graph_capture import CapturedRender


class WarpConfig(ComponentConfig):
    """Settings of WarpRasterizer."""

    cpu_kernels: Literal["auto", "native", "portable"] = "auto"
    """"native": vectorised; "portable": the kernels of CUDA as scalar code, about ten times slower,
    also for testing them without a GPU; "auto": native where they compile, else portable with a
    warning."""
    scheduler: Literal["threads", "openmp", "auto", "serial"] = "threads"
    """How CPU work is spread over cores. "threads": Python threads. "openmp": torch's own pool, 5
    to 15 % faster where nothing else runs (more for small images) and slower where other processes
    use the cores, since its workers wait by spinning; it uses private parts of Warp, which a trial
    run checks. "auto": openmp where the trial passes, else threads. "serial": the calling thread.
    `WarpRasterizer.backend_report()` says which is used, and why."""
    threads: int | None = Field(default=None, ge=1)
    """CPU cores to use; torch.get_num_threads() when None."""


DEFAULT = RenderRequest()


class WarpRasterizer(Rasterizer):
    """Draws by the rules of `hoigs.core.maths.projection`, in float32, with its own backward.

    The first render on a machine compiles its kernels (some seconds) into Warp's cache
    (`WARP_CACHE_PATH`); later processes load them in milliseconds. Two renders of the same input
    agree bit for bit, whatever the scheduler and the number of threads.

    On CUDA everything runs on torch's current stream. Only a render with more Gaussians or more
    pixels than any before it waits for the device, to count its tile intersections (pairs of a
    Gaussian and a tile that it touches). Later renders allocate memory for 1.5 times the largest
    number so far. A view that exceeds it is still drawn right, with the same picture, but some
    times slower, its gradients are summed in no fixed order, and the next one allocates more (after
    two such views, where Gaussians are many). A render holds 20 bytes for each intersection (12 of
    them until it is drawn) and 92 for each Gaussian. Until they are summed, its backward holds 4
    (10 + feature channels) more for each intersection, where possible in the memory of the colours'
    gradient. Steps can be captured in a CUDA graph after a first one; `capture` does that for
    rendering.

    From 262,144 Gaussians and 48 for each 128 pixels on, the nearest sixth is drawn first. Of the
    others, only those are taken, and counted as intersections, that meet a tile where some pixel is
    not opaque yet.

    Raises:
        RenderError: at the first render: Warp is not installed, or the requested kernels or
            scheduler cannot be used here.
    """

    Config: ClassVar = WarpConfig
    cuda_graph_safe = True
    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32"}),
        camera_gradients=True,
        deterministic=True,
        absolute_gradients=True,
        optics=OPTICS,
    )

    def __init__(self, config: WarpConfig | None = None) -> None:
        self.config = config or WarpConfig()
        self.inputs = InputValidation(self.check_inputs)
        self._pipelines: dict[torch.device, Any] = {}
        self._report: dict[str, str] = {}

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        request = request or DEFAULT
        settings, tensors = self.inputs.prepare(gaussians, camera, request)
        pipeline = self.pipeline(gaussians.means.device)
        color, alpha, depth, features, *seen = render(pipeline, settings, tensors)
        means2d, depths, radii = seen
        info = {"radii": radii, "means2d": means2d, "depths": depths}
        return RenderOutput(
            color, alpha, depth, None if request.features is None else features, info
        )

    def capture(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> CapturedRender:
        """Capture a render on CUDA as a graph, to draw many views or moments with little delay.

            draw = rasterizer.capture(gaussians, camera)
            for view in views:
                image = draw(camera=view).color  # valid until the next call

        Sizes, SH bases and the numbers of the request are fixed; see CapturedRender. Without
        gradients.

        Raises:
            RenderError: the Gaussians are not on CUDA, or cannot be drawn.
        """
        device = gaussians.means.device
        if device.type != "cuda":
            raise RenderError(
                f"WarpRasterizer.capture: Gaussians are on {device}, expected a CUDA device, since "
                "CUDA graphs exist only there; use render, or move them with .to(...)"
            )
        return CapturedRender(
            self.pipeline(device),
            self.inputs.prepare,
            gaussians,
            camera,
            request or DEFAULT,
        )

    def graph_memory(self, device: torch.device) -> int:
        pipeline = self._pipelines.get(device)
        return 0 if pipeline is None or device.type != "cuda" else pipeline.capacity.now()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the settings; they load their own kernels."""
        return type(self), (self.config,)

    def backend_report(self) -> dict[str, str]:
        """What runs the kernels and why, for `hoigs doctor` and run provenance."""
        self.pipeline(torch.device("cpu"))
        return dict(self._report)

    def pipeline(self, device: torch.device) -> Any:
        """The stages of a render on a device; the first call loads its kernels."""
        if device not in self._pipelines:
            if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
                raise RenderError(
                    "WarpRasterizer: its first render must not be captured in a CUDA graph: render "
                    "once before the capture, backward included if that is captured too"
                )
            self._pipelines[device] = self._make_pipeline(device)
        return self._pipelines[device]

    def _make_pipeline(self, device: torch.device) -> Any:
        try:
            import warp
        except ImportError as error:
            raise RenderError(
                "WarpRasterizer needs Warp, which is not installed: pip install warp-lang"
            ) from error
        if device.type == "cuda":
            from hoigs.rasterizers.warp.cuda.pipeline import CudaPipeline

            self._report |= {"warp": warp.config.version, "cuda": "pixel kernels"}
            return CudaPipeline(device)
        from hoigs.rasterizers.warp.cpu.workers import Cores, choose_kernels, make_workers

        kernels, why = choose_kernels(self.config.cpu_kernels)
        workers, reason = make_workers(self.config.scheduler)
        self._report |= {
            "warp": warp.config.version,
            "cpu_kernels": kernels,
            "cpu_kernels_reason": why,
            "scheduler": workers.name,
            "scheduler_reason": reason,
        }
        cores = Cores(workers, self.config.threads)
        if kernels == "portable":
            from hoigs.rasterizers.warp.cpu.pipeline import PortablePipeline

            return PortablePipeline(cores)
        from hoigs.rasterizers.warp.cpu.pipeline import NativePipeline

        return NativePipeline(cores)
