"""RasterizerSubject: a backend on a device; and the conditions on which checks depend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.checks import CheckList, Need
from hoigs.testing.rasterizer.scenes import RAW, Scene, forged, on

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

FIELDS = ("features", "screen_offsets", "background", "absolute_gradients")
INPUTS = (*RAW, *FIELDS, "world_to_camera")


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
        leaves = {
            name: x.detach().clone().requires_grad_() for name, x in parts.items() if x is not None
        }
        view = {k: leaves[k] for k in ("world_to_camera",) if k in leaves}
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


CHECKS: CheckList[RasterizerSubject] = CheckList("R")


def subject(cls: type[Rasterizer], config: Any, options: Options) -> RasterizerSubject:
    """The backend of these settings, on the device of the options."""
    return RasterizerSubject(cls.from_config(config, BuildContext()), torch.device(options.device))


def camera_gradients(subject: RasterizerSubject) -> str | None:
    declared = subject.rasterizer.capabilities.camera_gradients
    return None if declared else "camera_gradients is not declared"


def absolute_gradients(subject: RasterizerSubject) -> str | None:
    declared = subject.rasterizer.capabilities.absolute_gradients
    return None if declared else "absolute_gradients is not declared"


def deterministic(subject: RasterizerSubject) -> str | None:
    declared = subject.rasterizer.capabilities.deterministic
    return None if declared else "deterministic is not declared"


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
