"""I01 to I05: shapes, numbers, and nothing where nothing is in reach."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.features import Tokens
from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require, require_finite, require_zero
from hoigs.testing.interaction.subject import (
    CHECKS,
    COUNTS,
    FAR,
    KINDS,
    Gathering,
    InteractionSubject,
    corrections,
)
from hoigs.testing.modules import weighed


@CHECKS.check("I01")
def residuals_fit_their_entities(subject: InteractionSubject) -> None:
    """Residuals are for entities that have tokens: poses [51, 3] of humans, means one a token."""
    residuals = subject.ask(subject.module(), subject.gathering())
    for name, residual in residuals.items():
        require(name in COUNTS, f'"{name}" has no tokens, and gets a residual')
        if residual.pose is not None:
            require(KINDS[name] == "human", f'"{name}" is no human, and gets a pose correction')
            require(residual.pose.shape == (51, 3), f"{name}.pose is {list(residual.pose.shape)}")
        if residual.means is not None:
            shape = list(residual.means.shape)
            require(shape == [COUNTS[name], 3], f"{name}.means is {shape}: one a token, [M, 3]")


@CHECKS.check("I02")
def dtype_and_device_are_kept(subject: InteractionSubject) -> None:
    """Residuals have dtype and device of the tokens, in float32 and in float64."""
    for dtype in (torch.float32, torch.float64):
        residuals = subject.ask(subject.module(dtype=dtype), subject.gathering(dtype))
        for name, x in corrections(residuals).items():
            same = x.dtype == dtype and x.device == subject.device
            require(same, f"{name} is {x.dtype} on {x.device}, the tokens {dtype}")


@CHECKS.check("I03")
def nothing_in_reach_asks_for_nothing(subject: InteractionSubject) -> None:
    """With every object far from every human, residuals are zero, or are not there."""
    apart = subject.gathering().shifted("cup", "box", by=(FAR, 0.0, 0.0))
    for name, x in corrections(subject.ask(subject.module(), apart)).items():
        require_finite(name, x.detach())
        require_zero(f"{name}, out of reach", x.detach())


@CHECKS.check("I04")
def out_of_reach_gradients_are_numbers(subject: InteractionSubject) -> None:
    """Near and far, values and gradients to parameters and tokens are finite."""
    whole = subject.gathering()
    for by in (0.0, 0.5, 0.7, 1.0, FAR):
        asked, leaves = with_leaves(whole.shifted("cup", "box", by=(by, 0.0, 0.0)))
        module = subject.module()
        found = corrections(subject.ask(module, asked))
        for name, x in found.items():
            require_finite(f"{name} at {by} m", x.detach())
        loss = weighed(found)
        if loss.requires_grad:
            loss.backward()
        for what, leaf in [*module.named_parameters(), *leaves.items()]:
            if leaf.grad is not None:
                require_finite(f"gradient of {what} at {by} m", leaf.grad)


@CHECKS.check("I05")
def who_is_far_does_not_matter(subject: InteractionSubject) -> None:
    """Of two objects, the one out of reach of all gets nothing, and the other is as if alone."""
    module = subject.module()
    whole = subject.gathering()
    apart = subject.ask(module, whole.shifted("box", by=(FAR, 0.0, 0.0)))
    alone = subject.ask(module, whole.only("ann", "bob", "cup"))
    for name, x in corrections(apart).items():
        if name.startswith("box."):
            require_zero(f"{name}, out of reach", x.detach())
            continue
        wanted = corrections(alone).get(name)
        if wanted is None:
            raise CheckError(f"{name} is asked for only beside an object that is far")
        off = float((x - wanted).detach().abs().max())
        require(off < 1e-5, f"{name} is off by {off:.2g} because of an object that is far")


def with_leaves(asked: Gathering) -> tuple[Gathering, dict[str, Tensor]]:
    """The same, with features of which gradients can be asked."""
    leaves = {n: t.features.detach().clone().requires_grad_() for n, t in asked.tokens.items()}
    tokens = {n: Tokens(leaves[n], t.positions) for n, t in asked.tokens.items()}
    return Gathering(tokens, asked.roles), {f"{n}.features": x for n, x in leaves.items()}
