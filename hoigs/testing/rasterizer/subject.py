"""RasterizerSubject: a backend on a device; and the conditions on which checks depend."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any, TypeVar

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.rasterizer import Capabilities, Rasterizer, RenderOutput, RenderRequest
from hoigs.core.maths.optics import Optics
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import FIELDS as RAW
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.oracle import OracleConfig, OracleRasterizer
from hoigs.testing.checks import (
    CheckError,
    CheckList,
    Need,
    require,
    require_close,
    require_close_gradient,
    require_finite,
    require_zero,
)
from hoigs.testing.runner import Options

# Small scenes for rasterizers, made on the CPU in float32, the same on every machine.

Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Scene:
    """What `Rasterizer.render` takes."""

    gaussians: Gaussians
    camera: Camera
    request: RenderRequest = field(default_factory=RenderRequest)

    def __len__(self) -> int:
        return len(self.gaussians)


def random_gaussians(count: int = 150, *, degree: int = 3, seed: int = 0) -> Gaussians:
    """Random Gaussians around the origin, one to ten pixels large in `a_camera`."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(count, 3) * 0.8,
        quats=normal(count, 4),
        log_scales=normal(count, 3) * 0.6 - 2.2,
        opacity_logits=normal(count),
        sh=normal(count, (degree + 1) ** 2, 3) * 0.3,
    )


def random_scene(
    count: int = 150, *, degree: int = 3, seed: int = 0, channels: int = 4, offset: float = 0.5
) -> Scene:
    """`random_gaussians` before `a_camera`, with every tensor that a request can hold.

    Args:
        channels: of the features.
        offset: standard deviation of the screen offsets, pixels.
    """
    generator = torch.Generator().manual_seed(seed + 100)
    camera = a_camera()
    request = RenderRequest(
        features=torch.randn(count, channels, generator=generator),
        screen_offsets=torch.randn(count, 2, generator=generator) * offset,
        background=torch.rand(camera.height, camera.width, 3, generator=generator),
    )
    return Scene(random_gaussians(count, degree=degree, seed=seed), camera, request)


def a_camera(width: int = 44, height: int = 30) -> Camera:
    """Turned about every axis, unequal focal lengths, principal point off the middle."""
    camera = Camera.look_at(
        torch.tensor([1.0, -0.7, -3.0]),
        torch.tensor([0.1, 0.05, 0.0]),
        width=width,
        height=height,
        fov_y=0.9,
        up=(0.2, 1.0, 0.1),
    )
    K = camera.K * torch.tensor([[1.1], [0.95], [1.0]])
    K[:2, 2] = torch.tensor([0.43 * width, 0.58 * height])
    return Camera(K, camera.world_to_camera, width, height)


def front_camera(
    width: int = 21, height: int = 15, focal: float = 20.0, *, cx: float = 10.5, cy: float = 7.5
) -> Camera:
    """At the origin, along +z."""
    K = torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return Camera(K, torch.eye(4), width, height)


def one_gaussian(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    *,
    scale: float = 0.2,
    opacity: float = 0.6,
    color: tuple[float, float, float] = (0.9, 0.4, 0.1),
) -> Gaussians:
    point, rgb = (torch.tensor([x], dtype=torch.float32) for x in (mean, color))
    return Gaussians.from_points(point, rgb, scales=scale, opacity=opacity)


def images(output: RenderOutput) -> dict[str, Tensor]:
    """The pictures of an output by name; features only where there are some."""
    found = {"color": output.color, "alpha": output.alpha, "depth": output.depth}
    if output.features is not None:
        found["features"] = output.features
    return found


def on(device: torch.device, value: Value) -> Value:
    """Gaussians, a Camera or a RenderRequest, moved."""
    moved: dict[str, Any] = {
        f.name: v.to(device)
        for f in fields(value)  # type: ignore[arg-type]
        if isinstance(v := getattr(value, f.name), Tensor)
    }
    if isinstance(optics := getattr(value, "optics", None), Optics):
        moved["optics"] = optics.map_pose(lambda pose: pose.to(device))
    return forged(value, **moved)


def forged(value: Value, **changes: Any) -> Value:
    """A copy of a frozen dataclass with fields replaced, without its own checks."""
    result = copy.copy(value)
    for name, change in changes.items():
        object.__setattr__(result, name, change)
    return result


FIELDS = ("features", "screen_offsets", "background", "absolute_gradients")
INPUTS = (*RAW, *FIELDS, "world_to_camera", "last_world_to_camera")


@dataclass(frozen=True)
class RasterizerSubject:
    """What is checked: a rasterizer, drawing on one device."""

    rasterizer: Rasterizer
    device: torch.device

    def __str__(self) -> str:
        return f"{type(self.rasterizer).__name__} on {self.device}"

    def render(
        self, gaussians: Gaussians, camera: Camera, request: RenderRequest | None = None
    ) -> RenderOutput:
        """Draw on the device; the inputs are on the CPU."""
        request = None if request is None else on(self.device, request)
        return self.rasterizer.render(on(self.device, gaussians), on(self.device, camera), request)

    def draw(self, scene: Scene) -> RenderOutput:
        return self.render(scene.gaussians, scene.camera, scene.request)

    def drawn(
        self, scene: Scene, loss: Callable[[RenderOutput], Tensor]
    ) -> tuple[RenderOutput, dict[str, Tensor | None]]:
        """The output, and the gradients of loss(output) by name (INPUTS), on the CPU.

        Inputs that the scene lacks are left out; None stands for a missing gradient. The pose is
        included where the backend declares `camera_gradients`.
        """
        parts: dict[str, Any] = {name: getattr(scene.gaussians, name) for name in RAW}
        for name in FIELDS:
            parts[name] = getattr(scene.request, name)
        if self.rasterizer.capabilities.camera_gradients:
            parts["world_to_camera"] = scene.camera.world_to_camera
            if scene.camera.optics is not None:
                parts["last_world_to_camera"] = scene.camera.optics.last_world_to_camera
        leaves = {
            name: x.detach().clone().requires_grad_() for name, x in parts.items() if x is not None
        }
        view: dict[str, Any] = {k: leaves[k] for k in ("world_to_camera",) if k in leaves}
        if "last_world_to_camera" in leaves and scene.camera.optics is not None:
            last = leaves["last_world_to_camera"]
            view["optics"] = replace(scene.camera.optics, last_world_to_camera=last)
        fields = {name: leaves[name] for name in FIELDS if name in leaves}
        output = self.render(
            Gaussians(*(leaves[name] for name in RAW)),
            forged(scene.camera, **view),
            scene.request.replace(**fields),
        )
        loss(output).backward()
        return output, {name: x.grad for name, x in leaves.items()}

    def choices(self, option: str, values: Sequence[float]) -> Sequence[float]:
        """Those values, or the only one that the backend declares for this option of a request."""
        fixed = self.rasterizer.capabilities.fixed
        return [fixed[option]] if option in fixed else values


def received(gradients: Mapping[str, Tensor | None], name: str, where: str = "") -> Tensor:
    """The gradient of an input, which has to be there and finite."""
    gradient = gradients[name]
    if gradient is None:
        raise CheckError(f"no gradient reached {name} {where}")
    require_finite(f"gradient of {name} {where}", gradient)
    return gradient


CHECKS: CheckList[RasterizerSubject] = CheckList("R")


def subject(cls: type[Rasterizer], config: Any, options: Options) -> RasterizerSubject:
    """The backend of these settings, on the device of the options."""
    return RasterizerSubject(cls.from_config(config, BuildContext()), torch.device(options.device))


def declared(capability: str) -> Need:
    """The backend declares this field of its capabilities."""

    def need(subject: RasterizerSubject) -> str | None:
        found = getattr(subject.rasterizer.capabilities, capability)
        return None if found else f"{capability} is not declared"

    return need


camera_gradients = declared("camera_gradients")
absolute_gradients = declared("absolute_gradients")
deterministic = declared("deterministic")


def float64(subject: RasterizerSubject) -> str | None:
    declared = "float64" in subject.rasterizer.capabilities.dtypes
    return None if declared else "float64 is not among the declared dtypes"


def fixed_options(subject: RasterizerSubject) -> str | None:
    declared = subject.rasterizer.capabilities.fixed
    return None if declared else "no option is declared fixed"


def free(*options: str) -> Need:
    """None of these options of a request is declared fixed."""

    def need(subject: RasterizerSubject) -> str | None:
        fixed = subject.rasterizer.capabilities.fixed
        bound = [f"{name} = {fixed[name]:g}" for name in options if name in fixed]
        return f"declared fixed: {', '.join(bound)}" if bound else None

    return need


# What the oracle draws, where it may be compared, and its gradients.

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
