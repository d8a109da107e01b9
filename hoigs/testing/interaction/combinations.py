"""I06 to I09: order, combinations and position of the entities."""

from __future__ import annotations

from dataclasses import replace

from hoigs.core.values.tokens import Tokens
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.interaction.subject import (
    CHECKS,
    InteractionSubject,
    corrections,
    require_same,
)

ALL = ("ann", "bob", "cup", "box")


@CHECKS.check("I06")
def order_of_entities_does_not_matter(subject: InteractionSubject) -> None:
    """Entities in another order get the same residuals."""
    module, whole = subject.module(), subject.inputs()
    expected = subject.run(module, whole)
    got = subject.run(module, whole.only("box", "bob", "cup", "ann"))
    require_same("in another order", got, expected, atol=1e-5)


@CHECKS.check("I07")
def order_of_an_objects_tokens_does_not_matter(subject: InteractionSubject) -> None:
    """Permuted tokens of an object have permuted residuals, and all others the same."""
    module, whole = subject.module(), subject.inputs()
    order, cup = [3, 0, 4, 2, 1], whole.tokens["cup"]
    turned = Tokens(cup.features[order], cup.positions[order])
    expected = corrections(subject.run(module, whole))
    if "cup.means" in expected:
        expected["cup.means"] = expected["cup.means"][order]
    got = corrections(subject.run(module, whole.with_tokens("cup", turned)))
    for name, x in expected.items():
        require_close(f"{name}, with permuted tokens", got[name], x, atol=1e-5)


@CHECKS.check("I08")
def every_combination_works(subject: InteractionSubject) -> None:
    """No entity, humans only, objects only, one of each, and objects of one or no token work."""
    module, whole = subject.module(), subject.inputs()
    cup = whole.tokens["cup"]
    one = whole.with_tokens("cup", Tokens(cup.features[:1], cup.positions[:1]))
    none = whole.with_tokens("cup", Tokens(cup.features[:0], cup.positions[:0]))
    combinations = {
        "no entity": whole.only(),
        "humans only": whole.only("ann", "bob"),
        "objects only": whole.only("cup", "box"),
        "one of each": whole.only("ann", "cup"),
        "an object of one token": one,
        "an object of no tokens": none,
    }
    for what, inputs in combinations.items():
        for name, x in corrections(subject.run(module, inputs)).items():
            entity = name.partition(".")[0]
            require(entity in inputs.tokens, f"with {what}, {entity} gets a residual")
            require_finite(f"{name} with {what}", x.detach())


@CHECKS.check("I09")
def position_in_the_world_does_not_matter(subject: InteractionSubject) -> None:
    """All entities moved together get the same residuals."""
    module, whole = subject.module(), subject.inputs()
    expected = subject.run(module, whole)
    moved = whole.shifted(*ALL, by=(3.0, -1.0, 2.0))
    require_same(
        "after a common translation", subject.run(module, replace(moved)), expected, atol=1e-4
    )
