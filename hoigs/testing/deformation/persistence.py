"""D15 to D18: checkpoints, seeds and copies."""

from __future__ import annotations

import random

import numpy as np
import torch

from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require
from hoigs.testing.deformation.evolving import evolved
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    DeformationSubject,
    apply,
    changed_by,
    require_same,
)
from hoigs.testing.modules import copied, perturb, plain_state, require_same_state


@CHECKS.check("D15")
def a_checkpoint_restores_it(subject: DeformationSubject) -> None:
    """The state dict after `evolve` and density control restores everything in a new instance."""
    entity = subject.entity()
    evolved(subject, entity)
    apply(entity, changed_by([0, 1, 2, 3, 4, 5, 6, 2, 5], fresh=[7, 8]))
    perturb(entity)
    fresh = subject.entity(seed=5, perturbed=False)
    fresh.resize(len(entity))
    try:
        fresh.load_state_dict(entity.state_dict())
    except RuntimeError as error:
        raise CheckError(f"a new instance cannot load the state dict: {error}") from error
    for time in INSIDE:
        got, expected = subject.draw(fresh, time), subject.draw(entity, time)
        require_same(f"loaded, at {time}", got, expected, atol=1e-6)


@CHECKS.check("D16")
def same_seed_same_model(subject: DeformationSubject) -> None:
    """Two instances from one random state of torch are equal, bit for bit."""
    first = subject.entity()
    random.random()  # generators that a spec does not seed must not matter
    np.random.random()
    second = subject.entity()
    require_same_state("built twice from one seed", first, second)
    require_same(
        "built twice from one seed", subject.draw(first, 0.4), subject.draw(second, 0.4), atol=0.0
    )


@CHECKS.check("D17")
def a_deep_copy_is_independent(subject: DeformationSubject) -> None:
    """A deep copy, made after a training pass, is equal and independent."""
    entity = subject.entity()
    before = subject.draw(entity, 0.4).detach().clone()
    twin = copied(entity, lambda entity: subject.draw(entity, 0.4))
    require_same("a deep copy", subject.draw(twin, 0.4), before, atol=0.0)
    perturb(twin, seed=8)
    require_same("after its copy changed", subject.draw(entity, 0.4), before, atol=0.0)


@CHECKS.check("D18")
def state_is_saved_without_pickle(subject: DeformationSubject) -> None:
    """The state dict holds only tensors, which safetensors saves and loads bit for bit."""
    entity = subject.entity()
    loaded = plain_state(entity)
    for name, x in entity.state_dict().items():
        require(torch.equal(loaded[name], x.cpu()), f"{name} is not the same after safetensors")
