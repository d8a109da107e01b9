"""I01 to I05: shapes, values, and zero residuals out of reach."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.values.tokens import Tokens
from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require, require_finite, require_zero
from hoigs.testing.interaction.subject import (
    CHECKS,
    COUNTS,
    FAR,
    KINDS,
    Inputs,
    InteractionSubject,
    corrections,
)
from hoigs.testing.modules import weighted_sum


@CHECKS.check("I01")
def residuals_fit_their_entities(subject: InteractionSubject) -> None:
    """Residuals are of entities with tokens: poses [51, 3] of humans, a mean for each token."""
    residuals = subject.run(subject.module(), subject.inputs())
    for name, residual in residuals.items():
        require(name in COUNTS, f'"{name}" has no tokens but gets a residual')
        if residual.pose is not None:
            require(KINDS[name] == "human", f'"{name}" is not a human but gets a pose correction')
            require(residual.pose.shape == (51, 3), f"{name}.pose is {list(residual.pose.shape)}")
        if residual.means is not None:
            shape = list(residual.means.shape)
            require(
                shape == [COUNTS[name], 3],
                f"{name}.means is {shape}: expected one for each token, [M, 3]",
            )


@CHECKS.check("I02")
def dtype_and_device_are_kept(subject: InteractionSubject) -> None:
    """Residuals have dtype and device of the tokens, in float32 and in float64."""
    for dtype in (torch.float32, torch.float64):
        residuals = subject.run(subject.module(dtype=dtype), subject.inputs(dtype))
        for name, x in corrections(residuals).items():
            same = x.dtype == dtype and x.device == subject.device
            require(same, f"{name} is {x.dtype} on {x.device}, the tokens {dtype}")


@CHECKS.check("I03")
def residuals_are_zero_out_of_reach(subject: InteractionSubject) -> None:
    """With every object far from every human, residuals are zero or absent."""
    apart = subject.inputs().shifted("cup", "box", by=(FAR, 0.0, 0.0))
    for name, x in corrections(subject.run(subject.module(), apart)).items():
        require_finite(name, x.detach())
        require_zero(f"{name}, out of reach", x.detach())


@CHECKS.check("I04")
def gradients_are_finite_out_of_reach(subject: InteractionSubject) -> None:
    """Near and far, values and gradients to parameters and tokens are finite."""
    whole = subject.inputs()
    for by in (0.0, 0.5, 0.7, 1.0, FAR):
        inputs, leaves = with_leaves(whole.shifted("cup", "box", by=(by, 0.0, 0.0)))
        module = subject.module()
        found = corrections(subject.run(module, inputs))
        for name, x in found.items():
            require_finite(f"{name} at {by} m", x.detach())
        loss = weighted_sum(found)
        if loss.requires_grad:
            loss.backward()
        for what, leaf in [*module.named_parameters(), *leaves.items()]:
            if leaf.grad is not None:
                require_finite(f"gradient of {what} at {by} m", leaf.grad)


@CHECKS.check("I05")
def distant_objects_do_not_matter(subject: InteractionSubject) -> None:
    """Of two objects, the one out of reach gets nothing, and the other gets the same as alone."""
    module = subject.module()
    whole = subject.inputs()
    apart = subject.run(module, whole.shifted("box", by=(FAR, 0.0, 0.0)))
    alone = subject.run(module, whole.only("ann", "bob", "cup"))
    for name, x in corrections(apart).items():
        if name.startswith("box."):
            require_zero(f"{name}, out of reach", x.detach())
            continue
        expected = corrections(alone).get(name)
        if expected is None:
            raise CheckError(f"{name} is present only beside an object that is far")
        off = float((x - expected).detach().abs().max())
        require(off < 1e-5, f"{name} changes by {off:.2g} because of an object that is far")


def with_leaves(inputs: Inputs) -> tuple[Inputs, dict[str, Tensor]]:
    """The same inputs, with features as leaves that require gradients."""
    leaves = {n: t.features.detach().clone().requires_grad_() for n, t in inputs.tokens.items()}
    tokens = {n: Tokens(leaves[n], t.positions) for n, t in inputs.tokens.items()}
    return Inputs(tokens, inputs.roles), {f"{n}.features": x for n, x in leaves.items()}
