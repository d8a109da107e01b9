"""WarpRasterizer: EWA splatting with Warp kernels, on CPUs and on CUDA."""

from __future__ import annotations

from typing import Any, Literal

import torch

from hoigs.core.camera import Camera
from hoigs.core.config import ComponentConfig
from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import Capabilities, Rasterizer, RenderOutput, RenderRequest


class WarpConfig(ComponentConfig):
    """Settings of WarpRasterizer; see there."""

    cpu_kernels: Literal["native", "portable"] = "native"
    scheduler: Literal["threads", "openmp", "auto", "serial"] = "threads"
    threads: int | None = None


class WarpRasterizer(Rasterizer):
    """Draws by the rules of `hoigs.core.projection`, in float32, with a hand-written backward.

    The first render on a machine compiles its kernels (some seconds) into Warp's cache
    (`WARP_CACHE_PATH`); later processes load them in milliseconds. Two renders of the same input
    agree bit for bit, whatever the scheduler and the number of threads.

    Args:
        cpu_kernels: "native", the fast ones, or "portable", the very kernels that CUDA runs, as
            scalar code (about ten times slower; for testing them without a GPU).
        scheduler: how CPU work is spread over cores. "threads": Python threads. "openmp": torch's
            own pool, 5 to 15 % faster where nothing else runs (more for small images) and slower
            where the cores are shared, since its workers wait by spinning; it reaches into private
            parts of Warp, checked by a trial. "auto": openmp where the trial passes, else threads.
            "serial": the calling thread. What runs, and why, stands in `backend_report()`.
        threads: CPU cores to use; torch.get_num_threads() when None.

    Raises:
        RenderError: Warp is not installed, or the scheduler asked for cannot be used here.
    """

    capabilities = Capabilities(
        devices=frozenset({"cpu", "cuda"}),
        dtypes=frozenset({"float32"}),
        camera_gradients=True,
        deterministic=True,
    )

    def __init__(
        self,
        cpu_kernels: Literal["native", "portable"] = "native",
        scheduler: Literal["threads", "openmp", "auto", "serial"] = "threads",
        threads: int | None = None,
    ) -> None:
        if threads is not None and threads < 1:
            raise RenderError(f"WarpRasterizer: threads is {threads}, expected at least 1")
        self.cpu_kernels, self.scheduler, self.threads = cpu_kernels, scheduler, threads
        self._paths: dict[str, Any] = {}
        self._report: dict[str, str] = {}

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        request = request or RenderRequest()
        self.check_inputs(gaussians, camera, request)
        from hoigs.rasterizers.warp.autograd import Render

        settings, tensors = _prepare(gaussians, camera, request)
        path = self._path(gaussians.means.device.type)
        color, alpha, depth, extra, means2d, depths, radii = Render.apply(path, settings, *tensors)
        info = {"radii": radii, "means2d": means2d, "depths": depths}
        return RenderOutput(color, alpha, depth, None if request.features is None else extra, info)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles carry the settings; they bring up their own kernels."""
        return type(self), (self.cpu_kernels, self.scheduler, self.threads)

    def backend_report(self) -> dict[str, str]:
        """What runs the kernels and why, for `hoigs doctor` and run provenance."""
        self._path("cpu")
        return dict(self._report)

    def _path(self, device: str) -> Any:
        if device not in self._paths:
            self._paths[device] = self._make_path(device)
        return self._paths[device]

    def _make_path(self, device: str) -> Any:
        try:
            import warp
        except ImportError as error:
            raise RenderError(
                "WarpRasterizer needs Warp, which is not installed: pip install warp-lang"
            ) from error
        from hoigs.rasterizers.warp.launchers import Cores, CudaStream
        from hoigs.rasterizers.warp.pixels import PixelPath

        if device == "cuda":
            self._report |= {"warp": warp.config.version, "cuda": "pixel kernels"}
            return PixelPath(CudaStream())
        from hoigs.rasterizers.warp.workers import make_workers

        workers, reason = make_workers(self.scheduler)
        self._report |= {
            "warp": warp.config.version,
            "cpu_kernels": self.cpu_kernels,
            "scheduler": workers.name,
            "scheduler_reason": reason,
        }
        cores = Cores(workers, self.threads)
        if self.cpu_kernels == "portable":
            return PixelPath(cores)
        from hoigs.rasterizers.warp.cpu import NativePath

        return NativePath(cores)


def _prepare(gaussians: Gaussians, camera: Camera, request: RenderRequest) -> tuple[Any, list]:
    """Settings, and tensors in the order of `frame.Inputs`: contiguous, absent ones empty."""
    from hoigs.rasterizers.warp.frame import Settings, check_addressable

    like = gaussians.means
    count, stored = gaussians.sh.shape[:2]
    degree = request.sh_degree
    settings = Settings(
        width=camera.width,
        height=camera.height,
        bands=stored if degree is None else min(stored, (degree + 1) ** 2),
        near=request.near,
        low_pass=request.low_pass,
        max_alpha=request.max_alpha,
        min_alpha=request.min_alpha,
        min_transmittance=request.min_transmittance,
    )
    if request.near < 0:
        raise RenderError(f"WarpRasterizer: near is {request.near}, expected 0 or more (metres)")
    channels = 0 if request.features is None else request.features.shape[1]
    check_addressable(
        camera.width * camera.height * max(3, channels),
        f"{camera.width}x{camera.height} pixels with {channels} feature channels",
    )
    background = like.new_zeros(3) if request.background is None else request.background
    features, offsets, subset = request.features, request.screen_offsets, request.subset
    tensors = [
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        like.new_empty(count, 0) if features is None else features,
        like.new_empty(0, 2) if offsets is None else offsets,
        background,
        camera.world_to_camera,
        camera.K,
    ]
    tensors = [x.to(like).contiguous() for x in tensors]
    subset = torch.empty(0, dtype=torch.bool) if subset is None else subset
    tensors.append(subset.to(like.device).contiguous().view(torch.uint8))
    return settings, tensors
