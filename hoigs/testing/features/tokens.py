"""F01 to F07 and F13: shapes, values, gradients, positions and number of tokens."""

from __future__ import annotations

import torch

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.deformation import ProvidesField
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.deformation.subject import apply, changed_by
from hoigs.testing.features.subject import (
    CHECKS,
    INSIDE,
    OUTSIDE,
    FeaturesSubject,
    by_name,
    learns,
    require_same,
)
from hoigs.testing.material.clip import moment_at
from hoigs.testing.modules import (
    require_finite_gradients,
    require_gradients,
    require_true_gradients,
    trained,
    weighted_sum,
)


@CHECKS.check("F01")
def as_many_positions_as_features(subject: FeaturesSubject) -> None:
    """M tokens are features [M, width] and positions [M, 3], for 1 and for 7 Gaussians."""
    for count in (1, 7):
        entity = subject.entity(count)
        tokens, features = subject.tokens(entity, 0.4), entity.features
        assert features is not None
        number, width = len(tokens.features), features.width
        got = list(tokens.features.shape)
        require(got == [number, width], f"features are {got}, width is {width}")
        require(
            tokens.positions.shape == (number, 3),
            f"{number} tokens have positions {list(tokens.positions.shape)}",
        )


@CHECKS.check("F02")
def dtype_and_device_are_kept(subject: FeaturesSubject) -> None:
    """Tokens have dtype and device of the Gaussians, in float32 and in float64."""
    for dtype in (torch.float32, torch.float64):
        entity = subject.entity(dtype=dtype)
        for name, x in by_name(subject.tokens(entity, 0.4)).items():
            same = x.dtype == dtype and x.device == entity.means.device
            require(same, f"{name} are {x.dtype} on {x.device}, the Gaussians {dtype}")


@CHECKS.check("F03")
def values_are_finite(subject: FeaturesSubject) -> None:
    """Tokens and their gradients are finite inside the clip, at its ends and outside."""
    for perturbed in (False, True):
        entity = subject.entity(perturbed=perturbed)
        for time in (*INSIDE, *OUTSIDE):
            tokens = by_name(subject.tokens(entity, time))
            for name, x in tokens.items():
                require_finite(f"{name} at {time}", x)
            require_finite_gradients(entity, weighted_sum(tokens))


@CHECKS.check("F04")
def order_of_gaussians_does_not_matter(subject: FeaturesSubject) -> None:
    """Permuted Gaussians have permuted tokens, or the same where tokens are not one each."""
    order = [3, 0, 6, 2, 5, 1, 4]
    plain, permuted = subject.entity(), subject.entity()
    apply(permuted, changed_by(order))
    expected, got = subject.tokens(plain, 0.4), subject.tokens(permuted, 0.4)
    if len(expected.features) == len(order):
        expected = type(expected)(expected.features[order], expected.positions[order])
    require_same("permuted", got, expected)


@CHECKS.check("F05", learns)
def every_parameter_gets_a_gradient(subject: FeaturesSubject) -> None:
    """Every trained parameter gets a gradient from some moment."""
    entity = subject.entity()
    assert entity.features is not None
    times = [i / 16 for i in range(17)]
    losses = (weighted_sum({"features": subject.tokens(entity, t).features}) for t in times)
    require_gradients(entity.features, losses)


@CHECKS.check("F06", learns)
def gradients_are_derivatives(subject: FeaturesSubject) -> None:
    """In float64, the gradient of every parameter is the slope of the tokens."""
    entity = subject.entity(dtype=torch.float64)
    assert entity.features is not None
    for time in (0.37, 0.81):
        require_true_gradients(
            trained(entity.features),
            lambda time=time: weighted_sum(by_name(subject.tokens(entity, time))),  # type: ignore[misc]
        )


@CHECKS.check("F07")
def tokens_are_where_the_entity_is(subject: FeaturesSubject) -> None:
    """Positions of tokens are among the Gaussians, or on the body, at that moment."""
    entity = subject.entity()
    for time in (0.0, 0.6):
        moment = moment_at(time, entity.means.dtype, entity.means.device)
        drawn = entity(moment).means
        assert isinstance(entity.deformation, ProvidesField)
        field = entity.deformation.posed_field(entity.canonical, moment)[1]
        positions = subject.tokens(entity, time).positions
        far = []
        for around in (drawn, field):
            low, high = around.amin(0), around.amax(0)
            far.append(float((positions - positions.clamp(low, high)).norm(dim=-1).max()))
        require_close(f"distance of tokens to the entity at {time}", min(far), 0.0, atol=0.05)


@CHECKS.check("F13")
def as_many_tokens_as_declared(subject: FeaturesSubject) -> None:
    """As many tokens as `tokens` declares: one for each Gaussian or body part, or "any" number."""
    for count in (1, 7, 16, 20):
        entity = subject.entity(count)
        assert entity.features is not None
        declared, number = entity.features.tokens, len(subject.tokens(entity, 0.4).positions)
        expected = {"gaussian": count, "part": len(PART_NAMES), "any": number}[declared]
        require(
            number == expected,
            f"{number} tokens for {count} Gaussians, but `tokens` is {declared!r}",
        )
