"""I06 to I09: order, company and place of the entities."""

from __future__ import annotations

from dataclasses import replace

from hoigs.core.features import Tokens
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
    """Entities named in another order get the same residuals."""
    module, whole = subject.module(), subject.gathering()
    wanted = subject.ask(module, whole)
    got = subject.ask(module, whole.only("box", "bob", "cup", "ann"))
    require_same("in another order", got, wanted, atol=1e-5)


@CHECKS.check("I07")
def order_of_an_objects_tokens_does_not_matter(subject: InteractionSubject) -> None:
    """Permuted tokens of an object have permuted residuals, and all others the same."""
    module, whole = subject.module(), subject.gathering()
    order, cup = [3, 0, 4, 2, 1], whole.tokens["cup"]
    turned = Tokens(cup.features[order], cup.positions[order])
    wanted = corrections(subject.ask(module, whole))
    if "cup.means" in wanted:
        wanted["cup.means"] = wanted["cup.means"][order]
    got = corrections(subject.ask(module, whole.with_tokens("cup", turned)))
    for name, x in wanted.items():
        require_close(f"{name}, with permuted tokens", got[name], x, atol=1e-5)


@CHECKS.check("I08")
def any_company_will_do(subject: InteractionSubject) -> None:
    """Nobody, humans alone, objects alone, one of each, and an object of one token: no errors."""
    module, whole = subject.module(), subject.gathering()
    cup = whole.tokens["cup"]
    one = whole.with_tokens("cup", Tokens(cup.features[:1], cup.positions[:1]))
    none = whole.with_tokens("cup", Tokens(cup.features[:0], cup.positions[:0]))
    companies = {
        "nobody": whole.only(),
        "humans alone": whole.only("ann", "bob"),
        "objects alone": whole.only("cup", "box"),
        "one of each": whole.only("ann", "cup"),
        "an object of one token": one,
        "an object of no tokens": none,
    }
    for what, asked in companies.items():
        for name, x in corrections(subject.ask(module, asked)).items():
            entity = name.partition(".")[0]
            require(entity in asked.tokens, f"with {what}, {entity} gets a residual")
            require_finite(f"{name} with {what}", x.detach())


@CHECKS.check("I09")
def the_place_in_the_world_does_not_matter(subject: InteractionSubject) -> None:
    """All of them moved together get the same residuals."""
    module, whole = subject.module(), subject.gathering()
    wanted = subject.ask(module, whole)
    moved = whole.shifted(*ALL, by=(3.0, -1.0, 2.0))
    require_same("elsewhere", subject.ask(module, replace(moved)), wanted, atol=1e-4)
