"""Conformance of feature extractors: `CHECKS`, on a motion that provides everything."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import ProvidesField
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.tokens import Tokens
from hoigs.testing import modules
from hoigs.testing.checks import CheckList, require, require_close
from hoigs.testing.deformation import apply, changed_by, follow
from hoigs.testing.material import OBJECT, TinyMotion, moment_at, object_track, tiny_clip
from hoigs.testing.modules import (
    ModuleSubject,
    Moments,
    perturb,
    plain_state,
    require_gradients,
    require_true_gradients,
    seeded,
    trained,
    weighted_sum,
)

COUNT = 7
INSIDE = (0.0, 0.13, 0.5, 1.0)
OUTSIDE = (-0.2, 1.2)


class FeaturesSubject(ModuleSubject[FeatureExtractor]):
    """The component under check; it describes an entity that moves."""

    times = (*INSIDE, *OUTSIDE)

    def entity(
        self,
        count: int = COUNT,
        *,
        seed: int = 0,
        perturbed: bool = True,
        dtype: torch.dtype = torch.float32,
    ) -> Entity:
        """An entity of `count` Gaussians with these features, in eval mode."""
        context = BuildContext(OBJECT, tiny_clip(), object_track=object_track())
        points = object_track().points[:count]

        def make() -> Entity:
            features = self.cls.from_config(self.config, context)
            canonical = Gaussians.from_points(points, scales=0.02)
            return Entity(canonical, TinyMotion(), features, kind="object")

        entity = seeded(make, seed)
        if perturbed:
            perturb(self.checked(entity))
        return entity.to(device=self.device, dtype=dtype).eval()

    made = entity

    def checked(self, made: Entity) -> FeatureExtractor:
        assert made.features is not None
        return made.features

    def cases(self, dtype: torch.dtype = torch.float32) -> Sequence[float]:
        return (0.4, 0.0, 0.77, 1.2)

    def outputs(self, made: Entity, case: float) -> dict[str, Tensor]:
        return by_name(self.tokens(made, case))

    def tokens(self, entity: Entity, time: float) -> Tokens:
        tokens = entity.tokens(moment_at(time, entity.means.dtype, entity.means.device))
        assert tokens is not None
        return tokens


CHECKS: CheckList[FeaturesSubject] = CheckList("F")
CHECKS.check("F02")(modules.keeps_dtype_and_device)
CHECKS.check("F10")(modules.same_seed_same_module)
CHECKS.check("F11")(modules.a_deep_copy_is_independent)
CHECKS.check("F12")(modules.cases_are_independent)
CHECKS.check("F03")(modules.values_are_finite)
subject = FeaturesSubject.of


def by_name(tokens: Tokens) -> dict[str, Tensor]:
    return {"features": tokens.features, "positions": tokens.positions}


def require_same(what: str, got: Tokens, expected: Tokens, atol: float = 1e-5) -> None:
    modules.require_same(what, by_name(got), by_name(expected), atol)


# F01 to F07 and F13: shapes, values, gradients, positions and number of tokens.


@CHECKS.check("F01")
def as_many_positions_as_features(subject: FeaturesSubject) -> None:
    """M tokens are features [M, width] and positions [M, 3], for 1 and for 7 Gaussians."""
    for count in (1, 7):
        entity = subject.entity(count)
        tokens = subject.tokens(entity, 0.4)
        number, width = len(tokens.features), subject.checked(entity).width
        got = list(tokens.features.shape)
        require(got == [number, width], f"features are {got}, width is {width}")
        require(
            tokens.positions.shape == (number, 3),
            f"{number} tokens have positions {list(tokens.positions.shape)}",
        )


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


@CHECKS.check("F05", modules.learns)
def every_parameter_gets_a_gradient(subject: FeaturesSubject) -> None:
    """Every trained parameter gets a gradient from some moment."""
    entity = subject.entity()
    times = [i / 16 for i in range(17)]
    losses = (weighted_sum({"features": subject.tokens(entity, t).features}) for t in times)
    require_gradients(subject.checked(entity), losses)


@CHECKS.check("F06", modules.learns)
def gradients_are_derivatives(subject: FeaturesSubject) -> None:
    """In float64, the gradient of every parameter is the slope of the tokens."""
    entity = subject.entity(dtype=torch.float64)
    for time in (0.37, 0.81):
        require_true_gradients(
            trained(subject.checked(entity)),
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
        declared = subject.checked(entity).tokens
        number = len(subject.tokens(entity, 0.4).positions)
        expected = {"gaussian": count, "part": len(PART_NAMES), "any": number}[declared]
        require(
            number == expected,
            f"{number} tokens for {count} Gaussians, but `tokens` is {declared!r}",
        )


# F08 and F09: rows, optimizer moments and checkpoints.


@CHECKS.check("F08")
def rows_and_moments_follow(subject: FeaturesSubject) -> None:
    """After density control, tokens and optimizer moments follow the rows."""
    before, after = subject.entity(), subject.entity()
    source = [0, 2, 3, 5, 2, 6, 1, 4]
    change = changed_by(source, fresh=[4])
    names = {f"features.{n}": p for n, p in trained(subject.checked(after)).items()}
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
