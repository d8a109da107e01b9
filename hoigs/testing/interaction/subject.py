"""InteractionSubject: a module with its settings, for two humans, two objects and a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import EntityKind, Residual, Role, Tokens
from hoigs.testing.checks import CheckList
from hoigs.testing.compare import require, require_close
from hoigs.testing.material.clip import tiny_clip
from hoigs.testing.modules import DeviceSubject, perturb, seeded

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

KINDS: dict[str, EntityKind] = {
    "ann": "human", "bob": "human", "cup": "object", "box": "object", "scene": "scene",
}  # fmt: skip
WIDTHS = {"ann": 6, "bob": 6, "cup": 4, "box": 4}
COUNTS = {"ann": len(PART_NAMES), "bob": len(PART_NAMES), "cup": 5, "box": 3}
PLACES = {"ann": -0.3, "bob": 0.3, "cup": 0.0, "box": 0.1}  # along x, metres: all within reach
FAR = 1e3


@dataclass(frozen=True)
class Inputs:
    """The inputs of an interaction: tokens and roles by entity."""

    tokens: dict[str, Tokens]
    roles: dict[str, Role]

    def only(self, *names: str) -> Inputs:
        """These entities, and the scene, in this order."""
        tokens = {n: self.tokens[n] for n in names}
        return Inputs(tokens, {n: self.roles[n] for n in (*names, "scene")})

    def with_tokens(self, name: str, tokens: Tokens) -> Inputs:
        return replace(self, tokens={**self.tokens, name: tokens})

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


class InteractionSubject(DeviceSubject[InteractionModule]):
    """The component under check."""

    def module(
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
            roles[name] = Role(KINDS[name], anchors, reach)
        return Inputs(tokens, roles)

    def run(self, module: InteractionModule, inputs: Inputs) -> Mapping[str, Residual]:
        return module(inputs.tokens, inputs.roles)


CHECKS: CheckList[InteractionSubject] = CheckList("I")


def subject(cls: type[InteractionModule], config: Any, options: Options) -> InteractionSubject:
    made = InteractionSubject(cls, config, torch.device(options.device))
    made.module()
    return made


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
    one, two = corrections(got), corrections(expected)
    require(set(one) == set(two), f"{what}: {sorted(set(one) ^ set(two))} is present only once")
    for name, x in two.items():
        require_close(f"{what}: {name}", one[name], x, atol=atol)


def learns(subject: InteractionSubject) -> str | None:
    trained = any(p.requires_grad for p in subject.module().parameters())
    return None if trained else "it has no parameters"
