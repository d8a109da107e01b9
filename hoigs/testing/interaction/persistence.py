"""I10 to I15: gradients, checkpoints, seeds, copies and inputs."""

from __future__ import annotations

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
    copied,
    perturb,
    plain_state,
    require_gradients,
    require_same_state,
    require_true_gradients,
    trained,
    unchanged,
    weighted_sum,
)


@CHECKS.check("I10", learns)
def every_parameter_gets_a_gradient(subject: InteractionSubject) -> None:
    """Every trained parameter gets a gradient, once heads are not zero."""
    module = subject.module()
    require_gradients(module, [weighted_sum(corrections(subject.run(module, subject.inputs())))])


@CHECKS.check("I11")
def gradients_are_derivatives(subject: InteractionSubject) -> None:
    """In float64, gradients of parameters and of the tokens' features agree with differences."""
    module = subject.module(dtype=torch.float64)
    inputs, leaves = with_leaves(subject.inputs(torch.float64))
    require_true_gradients(
        {**trained(module), **leaves},
        lambda: weighted_sum(corrections(subject.run(module, inputs))),
    )


@CHECKS.check("I12")
def a_checkpoint_restores_it(subject: InteractionSubject) -> None:
    """The state, saved without pickle, restores everything in a new instance."""
    module, fresh = subject.module(), subject.module(seed=5, perturbed=False)
    fresh.load_state_dict(plain_state(module))
    whole = subject.inputs()
    require_same("loaded", subject.run(fresh, whole), subject.run(module, whole))


@CHECKS.check("I13")
def same_seed_same_module(subject: InteractionSubject) -> None:
    """Two instances from one random state of torch are equal, bit for bit."""
    first = subject.module()
    random.random()
    require_same_state("built twice from one seed", first, subject.module())


@CHECKS.check("I14")
def a_deep_copy_is_independent(subject: InteractionSubject) -> None:
    """A call keeps no state for the next one; a deep copy, made after a
    training pass, is equal and independent."""
    module, whole = subject.module(), subject.inputs()
    first = subject.run(module, whole)
    subject.run(module, whole.only("ann", "box"))
    require_same("called again", subject.run(module, whole), first)
    twin = copied(module, lambda module: subject.run(module, whole))
    require_same("a deep copy", subject.run(twin, whole), first)
    perturb(twin, seed=8)
    require_same("after its copy changed", subject.run(module, whole), first)


@CHECKS.check("I15")
def inputs_are_not_modified(subject: InteractionSubject) -> None:
    """Tokens, anchors and reach are not written to."""
    module, whole = subject.module(), subject.inputs()
    inputs: dict[str, Tensor] = {}
    for part in (whole.tokens, whole.roles):
        for name, value in part.items():
            tensors = {k: x for k, x in vars(value).items() if isinstance(x, Tensor)}
            inputs |= {f"{name}.{k}": x for k, x in tensors.items()}
    with unchanged("", inputs), torch.no_grad():
        subject.run(module, whole)
