"""What the oracle draws, where it may be compared, and its gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import Capabilities, RenderOutput
from hoigs.rasterizers.oracle import OracleConfig, OracleRasterizer
from hoigs.testing.compare import require, require_close, require_close_gradient, require_zero
from hoigs.testing.rasterizer.scenes import Scene, images
from hoigs.testing.rasterizer.subject import INPUTS, RasterizerSubject

ORACLE = RasterizerSubject(OracleRasterizer(OracleConfig(cutoffs=True)), torch.device("cpu"))
PARTS = ("color", "alpha", "depth", "features")


@dataclass(frozen=True, eq=False)
class Reference:
    """The oracle's output for a scene; `clear` [H, W]: pixels that are not at a cut-off.

    At a cut-off one splat more or less may be drawn by rounding alone.
    """

    output: RenderOutput
    clear: Tensor


@lru_cache(maxsize=200)
def reference(scene: Scene) -> Reference:
    """The oracle's picture of a scene (not to be changed: it is kept)."""
    base = ORACLE.draw(scene)
    clear = torch.ones_like(base.alpha, dtype=torch.bool)
    for factor in (0.999, 1.001):
        for name in ("min_alpha", "min_transmittance"):
            changed = scene.request.replace(**{name: getattr(scene.request, name) * factor})
            moved = ORACLE.render(scene.gaussians, scene.camera, changed)
            clear &= (moved.alpha - base.alpha).abs() < 1e-9
    few = clear.numel() < 100  # so few pixels that one or two of them are already a tenth
    require(few or clear.float().mean() > 0.9, "the scene has too many pixels at its cut-offs")
    return Reference(base, clear)


def weighing(parts: Sequence[str], where: Tensor) -> Callable[[RenderOutput], Tensor]:
    """A loss: a fixed random weighting of these images at the pixels `where`."""

    def loss(output: RenderOutput) -> Tensor:
        generator = torch.Generator().manual_seed(9)
        total = torch.zeros((), dtype=torch.float64)
        for part, image in images(output).items():
            values = image.double().cpu()
            weights = torch.randn(values.shape, generator=generator, dtype=torch.float64)
            if part in parts:
                total = total + (values * weights)[where].sum()
        return total

    return loss


@lru_cache(maxsize=50)
def reference_gradients(scene: Scene, parts: tuple[str, ...] = PARTS) -> dict[str, Tensor | None]:
    """The oracle's gradients of `weighing(parts, clear pixels)`."""
    return ORACLE.drawn(scene, weighing(parts, reference(scene).clear))[1]


def require_reference_picture(subject: RasterizerSubject, scene: Scene) -> RenderOutput:
    """The subject's picture is the oracle's at the clear pixels (depth: relative to its scale)."""
    wanted, output = reference(scene), subject.draw(scene)
    limit = subject.rasterizer.capabilities.image_error
    for name, image in images(wanted.output).items():
        if image.numel() == 0:
            continue
        scale = max(1.0, float(image.abs().max())) if name == "depth" else 1.0
        got = images(output)[name].detach().double().cpu()
        require(got.shape == image.shape, f"{name} has shape {list(got.shape)}")
        require_close(name, got[wanted.clear], image[wanted.clear], atol=limit * scale)
    return output


def require_reference_gradients(
    subject: RasterizerSubject,
    scene: Scene,
    parts: tuple[str, ...] = PARTS,
    names: Sequence[str] = INPUTS,
) -> None:
    """Each of the subject's gradients is the oracle's; at least one of `names` is not zero."""
    wanted = reference_gradients(scene, parts)
    _, actual = subject.drawn(scene, weighing(parts, reference(scene).clear))
    capabilities: Capabilities = subject.rasterizer.capabilities
    compared = 0
    for name in names:
        want = wanted.get(name)
        if name not in actual:
            continue
        if want is None or not want.any():
            require_zero(f"gradient of {name}", actual[name])
            continue
        require_close_gradient(name, actual[name], want, capabilities.gradient_error)
        compared += 1
    require(compared > 0, f"no gradient of {', '.join(names)} is there to compare")
