"""I10 to I15: gradients, state, seeds, copies and inputs."""

from __future__ import annotations

import copy
import random

import torch
from torch import Tensor

from hoigs.testing.interaction.reach import with_leaves
from hoigs.testing.interaction.subject import (
    CHECKS,
    InteractionSubject,
    corrections,
    learns,
    require_same,
)
from hoigs.testing.modules import (
    perturb,
    plain_state,
    require_gradients,
    require_same_state,
    require_true_gradients,
    trained,
    unchanged,
    weighed,
)


@CHECKS.check("I10", learns)
def every_parameter_learns(subject: InteractionSubject) -> None:
    """Every trained parameter gets a gradient, once heads have left zero."""
    module = subject.module()
    require_gradients(module, [weighed(corrections(subject.ask(module, subject.gathering())))])


@CHECKS.check("I11")
def gradients_are_derivatives(subject: InteractionSubject) -> None:
    """In float64, gradients of parameters and of the tokens' features are slopes."""
    module = subject.module(dtype=torch.float64)
    asked, leaves = with_leaves(subject.gathering(torch.float64))
    require_true_gradients(
        {**trained(module), **leaves}, lambda: weighed(corrections(subject.ask(module, asked)))
    )


@CHECKS.check("I12")
def a_checkpoint_brings_it_back(subject: InteractionSubject) -> None:
    """The state, saved without pickle, brings everything back in a fresh one."""
    module, fresh = subject.module(), subject.module(seed=5, perturbed=False)
    fresh.load_state_dict(plain_state(module))
    whole = subject.gathering()
    require_same("loaded", subject.ask(fresh, whole), subject.ask(module, whole))


@CHECKS.check("I13")
def same_seed_same_module(subject: InteractionSubject) -> None:
    """Built twice from torch's same random state it is the same, bit for bit."""
    first = subject.module()
    random.random()
    require_same_state("built twice from one seed", first, subject.module())


@CHECKS.check("I14")
def a_deep_copy_is_another(subject: InteractionSubject) -> None:
    """It does not remember what it was asked; a deep copy is the same, and goes its own way."""
    module, whole = subject.module(), subject.gathering()
    first = subject.ask(module, whole)
    subject.ask(module, whole.only("ann", "box"))
    require_same("asked again", subject.ask(module, whole), first)
    twin = copy.deepcopy(module)
    require_same("a deep copy", subject.ask(twin, whole), first)
    perturb(twin, seed=8)
    require_same("after its copy changed", subject.ask(module, whole), first)


@CHECKS.check("I15")
def inputs_stay_as_they_were(subject: InteractionSubject) -> None:
    """Tokens, anchors and reach are not written to."""
    module, whole = subject.module(), subject.gathering()
    inputs: dict[str, Tensor] = {}
    for part in (whole.tokens, whole.roles):
        for name, value in part.items():
            tensors = {k: x for k, x in vars(value).items() if isinstance(x, Tensor)}
            inputs |= {f"{name}.{k}": x for k, x in tensors.items()}
    with unchanged("", inputs), torch.no_grad():
        subject.ask(module, whole)
