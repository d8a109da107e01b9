"""The implementations that are measured.

A peer draws a case and differentiates it; what it leaves out is in its note.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians


class NotMeasuredError(Exception):
    """A peer cannot run here, or not this case; the message says why."""


@dataclass
class Round:
    """One peer ready to draw one case.

    Attributes:
        forward: draws and keeps what backward needs; returns the picture [H, W, 3].
        backward: differentiates what forward drew last; None for drawing alone.
    """

    forward: Callable[[], Tensor]
    backward: Callable[[], None] | None


@dataclass(frozen=True)
class Peer:
    """A rasterizer by name; `prepare` raises NotMeasuredError where it cannot run."""

    name: str
    prepare: Callable[[Gaussians, Camera], Round]
    note: str = ""
    versions: dict[str, str] = field(default_factory=dict)


Draw = Callable[[Gaussians, Camera], tuple[Tensor, ...]]  # colour [H, W, 3], then others


def differentiated(draw: Draw) -> Callable[[Gaussians, Camera], Round]:
    """A round of a drawing function that autograd differentiates, by the same leaves every time, as
    the parameters of a training are."""

    def prepare(gaussians: Gaussians, camera: Camera) -> Round:
        leaves = gaussians.map(lambda x: x.detach().requires_grad_())
        upstream: list[Tensor] = []
        kept: list[tuple[Tensor, ...]] = []

        def forward() -> Tensor:
            kept[:] = [draw(leaves, camera)]
            return kept[0][0].detach()

        def backward() -> None:
            outputs = kept.pop()
            if not upstream:
                upstream.extend(torch.rand_like(x) for x in outputs)
            torch.autograd.backward(outputs, upstream)
            for leaf in leaves.tensors().values():
                leaf.grad = None

        return Round(forward, backward)

    return prepare


def ours(rasterizer: Any) -> Callable[[Gaussians, Camera], Round]:
    def draw(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
        output = rasterizer.render(gaussians, camera)
        return output.color, output.alpha, output.depth

    return differentiated(draw)


def warp(**options: Any) -> Callable[[Gaussians, Camera], Round]:
    from hoigs.rasterizers.warp import WarpRasterizer

    return ours(WarpRasterizer(WarpRasterizer.Config(**options)))


def warp_captured(gaussians: Gaussians, camera: Camera) -> Round:
    from hoigs.rasterizers.warp import WarpRasterizer

    if gaussians.means.device.type != "cuda":
        raise NotMeasuredError("CUDA graphs are there on CUDA alone")
    draw = WarpRasterizer().capture(gaussians, camera)
    return Round(lambda: draw(camera=camera).color, None)


def plain_torch(gaussians: Gaussians, camera: Camera) -> Round:
    from hoigs.rasterizers.torch_tiles import TorchRasterizer

    if camera.width * camera.height * len(gaussians) > 256 * 256 * 5000:
        raise NotMeasuredError("more than 256x256 with 5,000 Gaussians takes minutes")
    return ours(TorchRasterizer())(gaussians, camera)


def oracle(gaussians: Gaussians, camera: Camera) -> Round:
    from hoigs.rasterizers.oracle import OracleRasterizer

    if camera.width * camera.height * len(gaussians) > 64 * 64 * 2000:
        raise NotMeasuredError("dense in float64: 64x64 with 2,000 Gaussians at most")
    rasterizer = OracleRasterizer(OracleRasterizer.Config(cutoffs=True))
    return ours(rasterizer)(gaussians, camera)


def installed(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise NotMeasuredError(f"not installed: pip install {package}")


def gsplat(gaussians: Gaussians, camera: Camera) -> Round:
    if gaussians.means.device.type != "cuda":
        raise NotMeasuredError("its kernels need CUDA; see gsplat-torch")
    installed("gsplat")
    import gsplat as package

    request = RenderRequest()

    def draw(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
        image, alpha, _ = package.rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            gaussians.sh,
            camera.world_to_camera[None],
            camera.K[None],
            camera.width,
            camera.height,
            near_plane=request.near,
            eps2d=request.low_pass,
            sh_degree=gaussians.sh_degree,
            render_mode="RGB+D",
            packed=False,
        )
        return image[0, ..., :3], alpha[0, ..., 0], image[0, ..., 3]

    return differentiated(draw)(gaussians, camera)


def gswarp(gaussians: Gaussians, camera: Camera) -> Round:
    if gaussians.means.device.type != "cuda":
        raise NotMeasuredError("it refuses tensors that are not on CUDA")
    installed("gswarp")
    import gswarp as package

    device = gaussians.means.device
    near, far = 0.01, 100.0
    width, height = camera.width, camera.height
    fx, fy, cx, cy = (float(camera.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    clip = torch.tensor(
        [
            [2 * fx / width, 0, 2 * cx / width - 1, 0],
            [0, 2 * fy / height, 2 * cy / height - 1, 0],
            [0, 0, far / (far - near), -far * near / (far - near)],
            [0, 0, 1, 0],
        ],
        device=device,
    )
    settings = package.GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=width / (2 * fx),
        tanfovy=height / (2 * fy),
        bg=torch.zeros(3, device=device),
        scale_modifier=1.0,
        viewmatrix=camera.world_to_camera.T.contiguous(),
        projmatrix=(clip @ camera.world_to_camera).T.contiguous(),
        sh_degree=gaussians.sh_degree,
        campos=camera.center,
        prefiltered=False,
        auto_tune_verbose=False,
    )

    def draw(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, ...]:
        output = package.GaussianRasterizer(settings)(
            means3D=gaussians.means,
            means2D=torch.zeros_like(gaussians.means),
            opacities=gaussians.opacities[:, None],
            shs=gaussians.sh,
            scales=gaussians.scales,
            rotations=torch.nn.functional.normalize(gaussians.quats, dim=-1),
        )
        return (output[0].permute(1, 2, 0),)

    return differentiated(draw)(gaussians, camera)


def faster_gs(gaussians: Gaussians, camera: Camera) -> Round:
    """FasterGSCudaBackend of nerficg-project/faster-gaussian-splatting, built from its source."""
    if gaussians.means.device.type != "cuda":
        raise NotMeasuredError("its kernels need CUDA")
    if importlib.util.find_spec("FasterGSCudaBackend") is None:
        raise NotMeasuredError("not installed: it is built from its repository")
    from FasterGSCudaBackend.torch_bindings import RasterizerSettings, diff_rasterize

    device, request = gaussians.means.device, RenderRequest()
    fx, fy, cx, cy = (float(camera.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    settings = RasterizerSettings(
        camera.world_to_camera.contiguous(),
        camera.center.contiguous(),
        torch.zeros(3, device=device),
        (gaussians.sh_degree + 1) ** 2,
        camera.width,
        camera.height,
        fx,
        fy,
        cx,
        cy,
        request.near,
        1e3,
        False,
    )

    # its own leaves: slices of ours would not be contiguous, and their gradients be copied
    leaves = [
        part.detach().contiguous().requires_grad_()
        for part in (
            gaussians.means,
            gaussians.log_scales,
            gaussians.quats,
            gaussians.opacity_logits[:, None],
            gaussians.sh[:, :1],
            gaussians.sh[:, 1:],
        )
    ]
    upstream = torch.rand(3, camera.height, camera.width, device=device)
    kept: list[Tensor] = []

    def forward() -> Tensor:
        for leaf in leaves:
            leaf.grad = None
        kept[:] = [diff_rasterize(*leaves, torch.empty(0, device=device), settings)]
        return kept[0].detach().permute(1, 2, 0)

    return Round(forward, lambda: kept.pop().backward(upstream))


def _versions(*packages: str) -> dict[str, str]:
    found = {}
    for package in packages:
        if importlib.util.find_spec(package) is not None:
            found[package] = importlib.metadata.version(package)
    return found


def all_peers() -> dict[str, Callable[[], Peer]]:
    """Peers by name, made on request: importing one must not need another's packages."""
    from benchmarks.rasterizers import gsplat_torch

    return {
        "warp": lambda: Peer("warp", warp(), "the default: native kernels, Python threads"),
        "warp-openmp": lambda: Peer(
            "warp-openmp", warp(scheduler="openmp"), "native kernels on torch's own pool"
        ),
        "warp-portable": lambda: Peer(
            "warp-portable", warp(cpu_kernels="portable"), "CUDA's kernels as scalar code"
        ),
        "warp-captured": lambda: Peer(
            "warp-captured", warp_captured, "forward alone, replayed as a CUDA graph"
        ),
        "torch": lambda: Peer("torch", plain_torch, "our plain torch tiles"),
        "oracle": lambda: Peer("oracle", oracle, "our dense float64 reference"),
        "gsplat-torch": lambda: Peer(
            "gsplat-torch", gsplat_torch.prepare, gsplat_torch.NOTE, _versions("gsplat")
        ),
        "gsplat": lambda: Peer("gsplat", gsplat, "CUDA kernels", _versions("gsplat")),
        "faster-gs": lambda: Peer("faster-gs", faster_gs, "gradients from colour alone"),
        "gswarp": lambda: Peer(
            "gswarp", gswarp, "gradients from colour alone", _versions("gswarp")
        ),
    }
