"""F08 to F12: rows, optimizer moments, checkpoints, seeds and independence of moments."""

from __future__ import annotations

import random

import torch

from hoigs.testing.compare import require
from hoigs.testing.deformation.subject import apply, changed_by
from hoigs.testing.deformation.topology import follow
from hoigs.testing.features.subject import CHECKS, INSIDE, FeaturesSubject, require_same
from hoigs.testing.modules import Moments, copied, perturb, plain_state, require_same_state, trained


@CHECKS.check("F08")
def rows_and_moments_follow(subject: FeaturesSubject) -> None:
    """After density control, tokens and optimizer moments follow the rows."""
    before, after = subject.entity(), subject.entity()
    assert after.features is not None
    source = [0, 2, 3, 5, 2, 6, 1, 4]
    change = changed_by(source, fresh=[4])
    names = {f"features.{n}": p for n, p in trained(after.features).items()}
    moments = Moments(names)
    follow(after, change, moments)
    apply(after, change)
    moments.require_in_step({name: after.get_parameter(name) for name in names})
    expected, got = subject.tokens(before, 0.4), subject.tokens(after, 0.4)
    if len(expected.features) == len(before):
        expected = type(expected)(expected.features[source], expected.positions[source])
        require_same("after density control", got, expected)
    require(len(got.features) == len(expected.features), "the number of tokens is not as expected")


@CHECKS.check("F09")
def a_checkpoint_restores_it(subject: FeaturesSubject) -> None:
    """The state, saved without pickle, restores everything in a new instance with as many rows."""
    entity = subject.entity()
    apply(entity, changed_by([0, 1, 2, 3, 4, 5, 6, 2, 5], fresh=[7, 8]))
    perturb(entity)
    fresh = subject.entity(seed=5, perturbed=False)
    fresh.resize(len(entity))
    fresh.load_state_dict(plain_state(entity))
    for time in INSIDE:
        expected = subject.tokens(entity, time)
        require_same(f"loaded, at {time}", subject.tokens(fresh, time), expected, atol=1e-6)


@CHECKS.check("F10")
def same_seed_same_features(subject: FeaturesSubject) -> None:
    """Two instances from one random state of torch are equal, bit for bit."""
    first = subject.entity()
    random.random()
    require_same_state("built twice from one seed", first, subject.entity())


@CHECKS.check("F11")
def a_deep_copy_is_independent(subject: FeaturesSubject) -> None:
    """A deep copy, made after a training pass, is equal and independent."""
    entity = subject.entity()
    before = subject.tokens(entity, 0.4)
    before = type(before)(before.features.detach().clone(), before.positions.detach().clone())
    twin = copied(entity, lambda entity: subject.tokens(entity, 0.4))
    require_same("a deep copy", subject.tokens(twin, 0.4), before, atol=0.0)
    perturb(twin, seed=8)
    require_same("after its copy changed", subject.tokens(entity, 0.4), before, atol=0.0)


@CHECKS.check("F12")
@torch.no_grad()
def moments_are_independent(subject: FeaturesSubject) -> None:
    """Several moments in any order give the same as each alone."""
    together = subject.entity()
    drawn = [(time, subject.tokens(together, time)) for time in (0.0, 0.77, 0.13, 1.2, 0.77, 0.0)]
    for time, got in drawn:
        alone = subject.tokens(subject.entity(), time)
        require_same(f"at {time}, among other moments", got, alone, atol=1e-6)
