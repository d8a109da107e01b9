"""Conformance of interactions: `CHECKS`, on synthetic humans and objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import EntityKind, Residual, Role, Tokens
from hoigs.testing import modules
from hoigs.testing.checks import (
    CheckError,
    CheckList,
    require,
    require_close,
    require_finite,
    require_zero,
)
from hoigs.testing.material import tiny_clip
from hoigs.testing.modules import (
    ModuleSubject,
    perturb,
    require_true_gradients,
    seeded,
    trained,
    unchanged,
    weighted_sum,
)

KINDS: dict[str, EntityKind] = {
    "ann": "human", "bob": "human", "cup": "object", "box": "object", "scene": "scene",
}  # fmt: skip
WIDTHS = {"ann": 6, "bob": 6, "cup": 4, "box": 4}
COUNTS = {"ann": len(PART_NAMES), "bob": len(PART_NAMES), "cup": 5, "box": 3}  # tokens
PLACES = {"ann": -0.3, "bob": 0.3, "cup": 0.0, "box": 0.1}  # along x, metres: all within reach
FAR = 1e3
MORE = 2


@dataclass(frozen=True)
class Inputs:
    """The inputs of an interaction: tokens and roles by entity."""

    tokens: dict[str, Tokens]
    roles: dict[str, Role]

    def only(self, *names: str) -> Inputs:
        """These entities, and the scene, in this order."""
        tokens = {n: self.tokens[n] for n in names}
        return Inputs(tokens, {n: self.roles[n] for n in (*names, "scene")})

    def with_tokens(self, name: str, tokens: Tokens, more: int = 0) -> Inputs:
        """`more`: Gaussians of this entity beyond one for each token."""
        role = replace(self.roles[name], gaussians=len(tokens.positions) + more)
        return Inputs({**self.tokens, name: tokens}, {**self.roles, name: role})

    def shifted(self, *names: str, by: tuple[float, float, float]) -> Inputs:
        """These entities translated, with their anchors."""
        tokens, roles = dict(self.tokens), dict(self.roles)
        for name in names:
            step = self.tokens[name].positions.new_tensor(by)
            tokens[name] = replace(tokens[name], positions=tokens[name].positions + step)
            anchors = roles[name].anchors
            if anchors is not None:
                roles[name] = replace(roles[name], anchors=anchors + step)
        return Inputs(tokens, roles)


class InteractionSubject(ModuleSubject[InteractionModule]):
    """The component under check."""

    def made(
        self, *, seed: int = 0, perturbed: bool = True, dtype: torch.dtype = torch.float32
    ) -> InteractionModule:
        """A module bound to all five entities; by default with perturbed parameters."""

        def make() -> InteractionModule:
            module = self.cls.from_config(self.config, BuildContext(clip=tiny_clip()))
            module.bind(WIDTHS, KINDS)
            return module

        module = seeded(make, seed)
        if perturbed:
            perturb(module, size=0.2)
        return module.to(device=self.device, dtype=dtype).eval()

    def more(self, kind: EntityKind) -> int:
        """Gaussians of an entity beyond its tokens: MORE, unless a token for each is needed."""
        return 0 if self.cls.tokens.get(kind) == "gaussian" else MORE

    def inputs(self, dtype: torch.dtype = torch.float32) -> Inputs:
        """Two humans and two objects, all in reach of each other."""
        generator = torch.Generator().manual_seed(31)

        def draw(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator).to(self.device, dtype)

        tokens, roles = {}, {"scene": Role("scene")}
        for name, count in COUNTS.items():
            place = draw(count, 3) * 0.1
            place[:, 0] += PLACES[name]
            tokens[name] = Tokens(draw(count, WIDTHS[name]), place)
            anchors = reach = None
            if KINDS[name] == "human":
                anchors, reach = place[[0, 8, 9, 14, 15]], torch.tensor(0.7).to(place)
            roles[name] = Role(KINDS[name], anchors, reach, count + self.more(KINDS[name]))
        return Inputs(tokens, roles)

    def cases(self, dtype: torch.dtype = torch.float32) -> Sequence[Inputs]:
        return (self.inputs(dtype),)

    def outputs(self, made: InteractionModule, case: Inputs) -> dict[str, Tensor]:
        return corrections(self.run(made, case))

    def run(self, module: InteractionModule, inputs: Inputs) -> Mapping[str, Residual]:
        return module(inputs.tokens, inputs.roles)


CHECKS: CheckList[InteractionSubject] = CheckList("I")
CHECKS.check("I02")(modules.keeps_dtype_and_device)
CHECKS.check("I10", modules.learns)(modules.every_parameter_gets_a_gradient)
CHECKS.check("I12")(modules.a_checkpoint_restores_it)
CHECKS.check("I13")(modules.same_seed_same_module)
subject = InteractionSubject.of


def corrections(residuals: Mapping[str, Residual]) -> dict[str, Tensor]:
    """Every tensor of the residuals, as "entity.part"."""
    return {
        f"{name}.{part}": value
        for name, residual in residuals.items()
        for part in ("pose", "means")
        if (value := getattr(residual, part)) is not None
    }


def require_same(
    what: str, got: Mapping[str, Residual], expected: Mapping[str, Residual], atol: float = 1e-6
) -> None:
    modules.require_same(what, corrections(got), corrections(expected), atol)


# I01 to I05: shapes, values, and zero residuals out of reach.


@CHECKS.check("I01")
def residuals_fit_their_entities(subject: InteractionSubject) -> None:
    """Residuals are of entities with tokens: poses [51, 3] of humans, a mean for each Gaussian."""
    inputs = subject.inputs()
    residuals = subject.run(subject.made(), inputs)
    for name, residual in residuals.items():
        require(name in COUNTS, f'"{name}" has no tokens but gets a residual')
        if residual.pose is not None:
            require(KINDS[name] == "human", f'"{name}" is not a human but gets a pose correction')
            require(residual.pose.shape == (51, 3), f"{name}.pose is {list(residual.pose.shape)}")
        if residual.means is not None:
            shape, count = list(residual.means.shape), inputs.roles[name].gaussians
            require(
                shape == [count, 3],
                f"{name}.means is {shape}: expected one for each Gaussian, [{count}, 3], of which "
                f"it has {COUNTS[name]} tokens; where one for each is needed, declare it: "
                f'tokens = {{"{KINDS[name]}": "gaussian"}}',
            )


@CHECKS.check("I03")
def residuals_are_zero_out_of_reach(subject: InteractionSubject) -> None:
    """With every object far from every human, residuals are zero or absent."""
    apart = subject.inputs().shifted("cup", "box", by=(FAR, 0.0, 0.0))
    for name, x in corrections(subject.run(subject.made(), apart)).items():
        require_finite(name, x.detach())
        require_zero(f"{name}, out of reach", x.detach())


@CHECKS.check("I04")
def gradients_are_finite_out_of_reach(subject: InteractionSubject) -> None:
    """Near and far, values and gradients to parameters and tokens are finite."""
    whole = subject.inputs()
    for by in (0.0, 0.5, 0.7, 1.0, FAR):
        inputs, leaves = with_leaves(whole.shifted("cup", "box", by=(by, 0.0, 0.0)))
        module = subject.made()
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
    module = subject.made()
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


# I06 to I09: order, combinations and position of the entities.

ALL = ("ann", "bob", "cup", "box")


@CHECKS.check("I06")
def order_of_entities_does_not_matter(subject: InteractionSubject) -> None:
    """Entities in another order get the same residuals."""
    module, whole = subject.made(), subject.inputs()
    expected = subject.run(module, whole)
    got = subject.run(module, whole.only("box", "bob", "cup", "ann"))
    require_same("in another order", got, expected, atol=1e-5)


@CHECKS.check("I07")
def order_of_an_objects_tokens_does_not_matter(subject: InteractionSubject) -> None:
    """Permuted tokens of an object have permuted residuals, one each, and all others the same."""
    module, whole = subject.made(), subject.inputs()
    order, cup = [3, 0, 4, 2, 1], whole.tokens["cup"]
    turned = Tokens(cup.features[order], cup.positions[order])
    expected = corrections(subject.run(module, whole))
    more = subject.more("object")
    if "cup.means" in expected and not more:
        expected["cup.means"] = expected["cup.means"][order]
    got = corrections(subject.run(module, whole.with_tokens("cup", turned, more)))
    for name, x in expected.items():
        require_close(f"{name}, with permuted tokens", got[name], x, atol=1e-5)


@CHECKS.check("I08")
def every_combination_works(subject: InteractionSubject) -> None:
    """No entity, humans only, objects only, one of each, and objects of one or no token work."""
    module, whole = subject.made(), subject.inputs()
    cup, more = whole.tokens["cup"], subject.more("object")
    one = whole.with_tokens("cup", Tokens(cup.features[:1], cup.positions[:1]), more)
    none = whole.with_tokens("cup", Tokens(cup.features[:0], cup.positions[:0]), more)
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
    module, whole = subject.made(), subject.inputs()
    expected = subject.run(module, whole)
    moved = whole.shifted(*ALL, by=(3.0, -1.0, 2.0))
    require_same("after a common translation", subject.run(module, moved), expected, atol=1e-4)


# I10 to I15: gradients, checkpoints, seeds, copies and inputs.


@CHECKS.check("I11")
def gradients_are_derivatives(subject: InteractionSubject) -> None:
    """In float64, gradients of parameters and of the tokens' features agree with differences."""
    module = subject.made(dtype=torch.float64)
    inputs, leaves = with_leaves(subject.inputs(torch.float64))
    require_true_gradients(
        {**trained(module), **leaves},
        lambda: weighted_sum(corrections(subject.run(module, inputs))),
    )


@CHECKS.check("I14")
def a_deep_copy_is_independent(subject: InteractionSubject) -> None:
    """A call keeps no state for the next one; a deep copy, made after a
    training pass, is equal and independent."""
    module, whole = subject.made(), subject.inputs()
    first = subject.run(module, whole)
    subject.run(module, whole.only("ann", "box"))
    require_same("called again", subject.run(module, whole), first)
    modules.a_deep_copy_is_independent(subject)


@CHECKS.check("I15")
def inputs_are_not_modified(subject: InteractionSubject) -> None:
    """Tokens, anchors and reach are not written to."""
    module, whole = subject.made(), subject.inputs()
    inputs: dict[str, Tensor] = {}
    for part in (whole.tokens, whole.roles):
        for name, value in part.items():
            tensors = {k: x for k, x in vars(value).items() if isinstance(x, Tensor)}
            inputs |= {f"{name}.{k}": x for k, x in tensors.items()}
    with unchanged("", inputs), torch.no_grad():
        subject.run(module, whole)
