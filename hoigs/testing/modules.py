"""Helpers for checks of torch modules: perturbation, gradients, optimizer moments and state."""

from __future__ import annotations

import copy
import math
import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from hoigs.core.spec.train_schema import rate_names
from hoigs.core.values.topology import AxisChange, TopologyChange
from hoigs.testing.checks import (
    CheckError,
    Component,
    ComponentSubject,
    require,
    require_close,
    require_finite,
)
from hoigs.testing.runner import Options

Made = TypeVar("Made")
Module = TypeVar("Module", bound=nn.Module)

CPU = torch.device("cpu")
NUDGE = 0.03  # standard deviation of the noise that moves parameters off zero
STEPS = (1e-6, 1e-7, 1e-8)  # of difference quotients, in float64; a large step may cross a kink


@dataclass(frozen=True)
class DeviceSubject(ComponentSubject[Component]):
    """A component class with its settings, and the device on which it is checked."""

    device: torch.device = CPU


class ModuleSubject(DeviceSubject[Component], ABC):
    """A component that becomes a torch module: what the checks that kinds share run on."""

    times: Sequence[float] = ()  # of the cases in which values have to be finite

    @classmethod
    def of(cls, component: type[Component], config: Any, options: Options) -> Self:
        """The subject of a component; raises where that cannot be built."""
        subject = cls(component, config, torch.device(options.device))
        subject.made()
        return subject

    @abstractmethod
    def made(
        self, *, seed: int = 0, perturbed: bool = True, dtype: torch.dtype = torch.float32
    ) -> Any:
        """The module, in eval mode; by default with perturbed parameters."""

    def checked(self, made: Any) -> nn.Module:
        """The component itself within what `made` gives."""
        return made

    @abstractmethod
    def cases(self, dtype: torch.dtype = torch.float32) -> Sequence[Any]:
        """Inputs of the module: moments, or entities. Those that come first are the usual ones."""

    @abstractmethod
    def outputs(self, made: Any, case: Any) -> dict[str, Tensor]:
        """What the module computes of a case, by name."""


def seeded(make: Callable[[], Made], seed: int = 0) -> Made:
    """Call `make` with torch's global random generator at `seed`, and restore the generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


@torch.no_grad()
def perturb(module: nn.Module, seed: int = 1, size: float = NUDGE) -> None:
    """Add noise to every trained parameter, so that those that start at zero have an effect."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in module.parameters():
        if parameter.requires_grad and parameter.is_floating_point():
            noise = torch.randn(parameter.shape, generator=generator)
            parameter.add_((size * noise).to(parameter))


def copied(module: Module, run: Callable[[Module], object]) -> Module:
    """A deep copy made after a training pass whose graph has not been freed, as AveragedModel
    makes it.

    Raises:
        CheckError: torch cannot copy what the pass left in the module.
    """
    training = module.training
    module.train()
    with torch.enable_grad():
        held = run(module)
    try:
        twin = copy.deepcopy(module)
    except (RuntimeError, TypeError) as error:
        raise CheckError(
            f"after a training pass it cannot be copied: {str(error).splitlines()[0]}; a "
            "deformation names what a pass leaves in it in `transient`"
        ) from error
    del held
    module.train(training)
    return twin.train(training)


def weighted_sum(tensors: Mapping[str, Tensor]) -> Tensor:
    """A sum of all entries with different weights."""
    total = torch.zeros((), dtype=torch.float64)
    for seed, (_, x) in enumerate(sorted(tensors.items())):
        generator = torch.Generator().manual_seed(seed)
        weights = 0.5 + torch.rand(x.shape, generator=generator, dtype=torch.float64)
        total = total + (x.double().cpu() * weights).sum()
    return total


def trained(module: nn.Module) -> dict[str, nn.Parameter]:
    """Parameters that are trained and not empty."""
    return {n: p for n, p in module.named_parameters() if p.requires_grad and p.numel()}


def require_gradients(module: nn.Module, losses: Iterable[Tensor]) -> None:
    """Together, the losses give every trained parameter a gradient that is not all zero."""
    module.zero_grad()
    for loss in losses:
        if loss.requires_grad:
            loss.backward()
    without = []
    for name, parameter in trained(module).items():
        if parameter.grad is None or not bool((parameter.grad != 0).any()):
            without.append(name)
        else:
            require_finite(f"gradient of {name}", parameter.grad)
    module.zero_grad()
    if without:
        raise CheckError(f"no gradient reaches {', '.join(without)}: no output depends on them")


def require_finite_gradients(module: nn.Module, loss: Tensor) -> None:
    module.zero_grad()
    if loss.requires_grad:
        loss.backward()
    for name, parameter in module.named_parameters():
        if parameter.grad is not None:
            require_finite(f"gradient of {name}", parameter.grad)
    module.zero_grad()


def require_penalties(found: Mapping[str, Tensor], weights: Mapping[str, float]) -> None:
    """Penalties are finite scalars, and their weights are not negative."""
    for name, value in found.items():
        require(value.dim() == 0, f'penalty "{name}" has shape {list(value.shape)}')
        require_finite(f'penalty "{name}"', value)
    for name, weight in weights.items():
        require(weight >= 0, f'the weight of penalty "{name}" is {weight}')


def require_true_gradients(
    leaves: Mapping[str, Tensor], loss: Callable[[], Tensor], cut: Sequence[str] = ()
) -> None:
    """In float64, the gradient of every leaf agrees with central differences along a direction.

    The direction is close to the gradient, so that the slope is large also with many entries.

    Args:
        cut: prefixes of names to leave out.
    """
    leaves = {
        n: x for n, x in leaves.items() if x.numel() and not n.startswith(tuple(cut) or ("\0",))
    }
    value = loss()
    size = 1 + abs(float(value.detach()))
    found: Sequence[Tensor | None] = [None] * len(leaves)
    if value.requires_grad:
        found = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
    for seed, ((name, leaf), slope) in enumerate(zip(leaves.items(), found, strict=True)):
        slope = torch.zeros_like(leaf) if slope is None else slope
        generator = torch.Generator().manual_seed(seed)
        aside = torch.randn(leaf.shape, generator=generator, dtype=torch.float64).to(leaf)
        direction = slope / slope.norm().clamp_min(1e-30) + 0.7 * aside / aside.norm()
        direction = direction / direction.norm()
        got = float((slope * direction).sum())
        allowed = 1e-4 * float(slope.norm()) + 1e-6 * size
        expected = math.nan
        for step in STEPS:
            expected = slope_along(leaf, direction, loss, step)
            if abs(got - expected) <= allowed:
                break
        else:
            raise CheckError(
                f"gradient of {name}: the slope along a direction is {expected:.6g}, "
                f"the gradient gives {got:.6g}"
            )


def slope_along(leaf: Tensor, direction: Tensor, loss: Callable[[], Tensor], step: float) -> float:
    """Central difference of `loss` by a move of `leaf` along a unit direction."""
    before, values = leaf.detach().clone(), []
    for way in (step, -step):
        leaf.data.copy_(before + way * direction)
        values.append(float(loss().detach()))
    leaf.data.copy_(before)
    return (values[0] - values[1]) / (2 * step)


class Moments:
    """Stand-ins for an optimizer's moments: copies of the parameters, which follow index maps."""

    def __init__(self, parameters: Mapping[str, nn.Parameter]) -> None:
        self.parameters = dict(parameters)
        self.values = {name: p.detach().clone() for name, p in parameters.items()}
        self.fresh: dict[str, AxisChange] = {}

    def follow(self, name: str, change: TopologyChange | AxisChange) -> None:
        """Apply a change to the moments of one parameter, as hoigs' optimizer does."""
        if isinstance(change, TopologyChange):
            change = AxisChange(0, change.source, change.fresh)
        if name in self.values:
            self.values[name] = change.follow(self.values[name])
            self.fresh[name] = change

    def require_in_step(self, now: Mapping[str, nn.Parameter]) -> None:
        """Moments have their parameter's shape and, where rows are not fresh, its values."""
        for name, parameter in now.items():
            if parameter is not self.parameters.get(name, parameter):
                raise CheckError(
                    f"{name} is a new Parameter object, which the optimizer does "
                    "not have; change parameter.data"
                )
            if name not in self.values:
                continue
            moments = self.values[name]
            if moments.shape != parameter.shape:
                raise CheckError(
                    f"{name} has shape {list(parameter.shape)} after the change, its moments "
                    f"{list(moments.shape)}: name it in per_gaussian, or in axis_changes"
                )
            kept = torch.ones_like(moments, dtype=torch.bool)
            if name in self.fresh:
                change = self.fresh[name]
                kept.index_fill_(change.axis, change.fresh.nonzero().squeeze(1), False)
            if bool((moments[kept] != parameter.detach()[kept]).any()):
                raise CheckError(f"rows of {name} no longer match the rows of its moments")


def plain_state(module: nn.Module) -> dict[str, Tensor]:
    """The state dict after a round trip through safetensors, which holds only tensors.

    Raises:
        CheckError: it holds anything but tensors, or tensors that share memory.
    """
    state: dict[str, Any] = module.state_dict()
    others = [name for name, value in state.items() if not isinstance(value, Tensor)]
    if others:
        raise CheckError(
            f"the state dict holds {others[0]}, which is not a tensor; use tensors only"
        )
    try:
        return load(save({name: x.detach().cpu().contiguous() for name, x in state.items()}))
    except (RuntimeError, ValueError) as error:
        raise CheckError(f"safetensors cannot hold the state dict: {error}") from error


def require_same_state(what: str, a: nn.Module, b: nn.Module) -> None:
    """Bit for bit the same parameters and buffers."""
    one, two = a.state_dict(), b.state_dict()
    if set(one) != set(two):
        raise CheckError(f"{what}: {sorted(set(one) ^ set(two))} is in one of them only")
    for name, x in one.items():
        same = torch.equal(x, two[name]) if isinstance(x, Tensor) else x == two[name]
        if not same:
            raise CheckError(f"{what}: {name} differs")


@contextmanager
def unchanged(what: str, tensors: Mapping[str, Tensor] | Callable[[], Mapping[str, Tensor]]) -> Any:
    """Raise CheckError when any of these tensors is written to in this block.

    Args:
        tensors: or what gives them, before and after.
    """
    read = tensors if callable(tensors) else lambda: tensors
    before = {name: x.detach().clone() for name, x in read().items()}
    yield
    for name, x in read().items():
        if not torch.equal(x.detach().nan_to_num(math.pi), before[name].nan_to_num(math.pi)):
            raise CheckError(f"{what}{name} was changed in place")


# Checks that deformations, features and interactions share, each under a number of its own.


def learns(subject: ModuleSubject[Any]) -> str | None:
    return None if trained(subject.checked(subject.made())) else "it has no parameters"


def rates_exist_in_the_spec(subject: ModuleSubject[Any]) -> None:
    """Learning rates have names that a spec's train.rates has."""
    known = rate_names()
    for prefix, rate in subject.cls.rates.items():
        require(rate in known, f'rates["{prefix}"] is "{rate}"; train.rates has {known}')


def values_are_finite(subject: ModuleSubject[Any]) -> None:
    """Values and gradients are finite inside the clip, at its ends and outside, also untrained."""
    for perturbed in (False, True):
        made = subject.made(perturbed=perturbed)
        for time in subject.times:
            outputs = subject.outputs(made, time)
            for name, x in outputs.items():
                require_finite(f"{name} at {time}", x)
            require_finite_gradients(made, weighted_sum(outputs))


def every_parameter_gets_a_gradient(subject: ModuleSubject[Any]) -> None:
    """Every trained parameter gets a gradient from some input, once heads are not zero."""
    made = subject.made()
    losses = (weighted_sum(subject.outputs(made, case)) for case in subject.cases())
    require_gradients(made, losses)


def a_checkpoint_restores_it(subject: ModuleSubject[Any]) -> None:
    """The state, saved without pickle, restores everything in a new instance."""
    made, fresh = subject.made(), subject.made(seed=5, perturbed=False)
    fresh.load_state_dict(plain_state(made))
    case = subject.cases()[0]
    require_same("loaded", subject.outputs(fresh, case), subject.outputs(made, case), atol=1e-6)


def keeps_dtype_and_device(subject: ModuleSubject[Any]) -> None:
    """The output has dtype and device of the input, in float32 and in float64."""
    for dtype in (torch.float32, torch.float64):
        made = subject.made(dtype=dtype)
        for name, x in subject.outputs(made, subject.cases(dtype)[0]).items():
            same = x.dtype == dtype and x.device.type == subject.device.type
            require(same, f"{name} is {x.dtype} on {x.device}, the input {dtype} {subject.device}")


def same_seed_same_module(subject: ModuleSubject[Any]) -> None:
    """Two instances from one random state of torch are equal, bit for bit."""
    first = subject.made()
    random.random()  # generators that a spec does not seed must not matter
    np.random.random()
    second = subject.made()
    require_same_state("built twice from one seed", first, second)
    case = subject.cases()[0]
    expected = subject.outputs(first, case)
    require_same("built twice from one seed", subject.outputs(second, case), expected, atol=0.0)


def a_deep_copy_is_independent(subject: ModuleSubject[Any]) -> None:
    """A deep copy, made after a training pass, is equal and independent."""
    made, case = subject.made(), subject.cases()[0]
    before = {name: x.detach().clone() for name, x in subject.outputs(made, case).items()}
    twin = copied(made, lambda made: subject.outputs(made, case))
    require_same("a deep copy", subject.outputs(twin, case), before, atol=0.0)
    perturb(twin, seed=8)
    require_same("after its copy changed", subject.outputs(made, case), before, atol=0.0)


@torch.no_grad()
def cases_are_independent(subject: ModuleSubject[Any]) -> None:
    """Several inputs in any order give the same as each alone."""
    together, cases = subject.made(), subject.cases()[:4]
    for case in (*cases, *reversed(cases)):
        got = {name: x.clone() for name, x in subject.outputs(together, case).items()}
        alone = subject.outputs(subject.made(), case)
        require_same(f"at {case}, among others", got, alone, atol=1e-6)


def require_same(
    what: str, got: Mapping[str, Tensor], expected: Mapping[str, Tensor], atol: float
) -> None:
    """The same tensors by name, each to `atol`."""
    require(set(got) == set(expected), f"{what}: {sorted(set(got) ^ set(expected))} is there once")
    for name, x in expected.items():
        require_close(f"{what}: {name}", got[name], x, atol=atol)
