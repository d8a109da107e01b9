"""NanGuard: a step that is not finite is skipped, and the first such tensor is named."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from hoigs.core.errors import NotFiniteError
from hoigs.core.model.entity import name_of
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.values.gaussians import Gaussians


def first_not_finite(
    losses: Mapping[str, Tensor],
    gaussians: Mapping[str, Gaussians],
    parameters: Mapping[str, nn.Parameter],
) -> str | None:
    """Name of the first tensor with NaN or infinity, or None.

    In the order of computation: parameters, deformed Gaussians, losses, gradients.
    """
    for name, parameter in parameters.items():
        if not torch.isfinite(parameter).all():
            return f"parameter {name}"
    for entity, values in gaussians.items():
        for field, value in values.tensors().items():
            if not torch.isfinite(value).all():
                return f"{field} of the deformed Gaussians of {entity!r}"
    for name, loss in losses.items():
        if not torch.isfinite(loss).all():
            return f"loss term {name!r}"
    for name, parameter in parameters.items():
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all():
            return f"gradient of {name}"
    return None


def require_finite_outputs(model: SceneModel, state: SceneState) -> None:
    """Raise where a component computes NaN or infinity from finite parameters.

    A rasterizer may leave such Gaussians out, so that the loss and the gradients stay finite.

    Raises:
        NotFiniteError: naming the first such component, in the order of computation.
    """
    for name, tokens in state.tokens.items():
        _require_finite(model.entity(name).features, f"features of {name!r}", tokens)
    for name, residual in state.residuals.items():
        _require_finite(model.interaction, f"interaction, for {name!r}", residual)
    for name, gaussians in state.gaussians.items():
        _require_finite(model.entity(name).deformation, f"deformation of {name!r}", gaussians)


def _require_finite(part: nn.Module | None, role: str, output: object) -> None:
    if part is None or not is_dataclass(output):
        return
    for f in fields(output):
        value = getattr(output, f.name)
        if not isinstance(value, Tensor) or not value.is_floating_point():
            continue
        bad = int((~torch.isfinite(value)).sum())
        if bad and all(bool(torch.isfinite(p).all()) for p in part.parameters()):
            raise NotFiniteError(
                f"{role}: {name_of(part)} computed {bad} of {value.numel()} values of {f.name} as "
                "NaN or infinity from finite parameters; this is a fault of that component or of "
                "the clip's tracks that it reads"
            )


class NanGuard:
    """Counts skipped steps.

    Raises:
        NotFiniteError: by `failed`, at the `patience`-th skipped step in a row.
    """

    def __init__(self, patience: int = 10) -> None:
        self.patience = patience
        self.in_a_row = 0
        self.skipped: list[tuple[int, str]] = []
        self._watched: deque[tuple[int, Tensor, torch.cuda.Event | None]] = deque()

    def passed(self) -> None:
        self.in_a_row = 0

    def watch(self, step: int, finite: Bool[Tensor, ""]) -> None:
        """Take note of a step of which only the device knows whether its gradients were finite."""
        if not finite.is_cuda:
            self._watched.append((step, finite, None))
            return
        known = torch.empty_like(finite, device="cpu", pin_memory=True)
        known.copy_(finite, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(finite.device))
        self._watched.append((step, known, event))

    def read(self, culprit: Callable[[], str | None], wait: bool) -> bool:
        """Count the watched steps of which the answer is here; whether the last of these passed.

        Args:
            culprit: names what was not finite. wait: for the device, and so for all steps.
        """
        passed = True
        while self._watched:
            step, finite, event = self._watched[0]
            if event is not None and wait:
                event.synchronize()
            elif event is not None and not event.query():
                break
            self._watched.popleft()
            passed = bool(finite)
            if passed:
                self.passed()
            else:
                self.failed(step, culprit() or "a gradient")
        return passed

    def require_any(self, steps: int) -> None:
        """Raise NotFiniteError if every one of so many steps was skipped."""
        if steps and len(self.skipped) >= steps:
            raise NotFiniteError(
                f"none of {steps} steps could be taken: {self.skipped[0][1]} was not finite"
            )

    def failed(self, step: int, culprit: str) -> None:
        self.skipped.append((step, culprit))
        self.in_a_row += 1
        if self.in_a_row >= self.patience:
            raise NotFiniteError(
                f"step {step}: {culprit} is not finite, {self.in_a_row} steps in a row; lower its "
                "learning rate (train.rates) or check the frame's masks and depth"
            )


def gradients_finite(parameters: Mapping[str, nn.Parameter]) -> bool:
    """Whether all gradients are finite, by one fused operation."""
    gradients = [p.grad for p in parameters.values() if p.grad is not None]
    if not gradients:
        return True
    norms = torch._foreach_norm(gradients)
    return bool(torch.isfinite(torch.stack([n.float() for n in norms])).all())
