"""A person and things as tokens, and a cross-attention module for them."""

from __future__ import annotations

import torch

from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.values.tokens import Role, Tokens
from hoigs.plugins.interaction.cross_attention import CrossAttention, CrossAttentionConfig

ARM = 0.7


def module(perturbed: bool = True, widths=None, **settings) -> CrossAttention:
    torch.manual_seed(0)
    made = CrossAttention(CrossAttentionConfig(**settings))
    kinds = {"human": "human", "friend": "human", "ball": "object", "box": "object"}
    made.bind(
        widths or {"human": 96, "friend": 96, "ball": 32, "box": 32}, kinds | {"scene": "scene"}
    )
    if perturbed:
        with torch.no_grad():
            for parameter in made.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
    return made


def person(seed: int = 0, place=(0.0, 0, 0)) -> tuple[Tokens, Role]:
    g = torch.Generator().manual_seed(seed)
    place = torch.tensor(place)
    tokens = Tokens(torch.randn(16, 96, generator=g), place + 0.3 * torch.randn(16, 3, generator=g))
    anchors = place + torch.tensor(
        [[0.0, 0, 0], [0.7, 0.45, 0], [-0.7, 0.45, 0], [0.1, -0.95, 0], [-0.1, -0.95, 0]]
    )
    return tokens, Role("human", anchors, torch.tensor(ARM))


def thing(count: int = 20, seed: int = 1, place=(0.8, 0.5, 0)) -> Tokens:
    g = torch.Generator().manual_seed(seed)
    noise = 0.05 * torch.randn(count, 3, generator=g)
    return Tokens(torch.randn(count, 32, generator=g), torch.tensor(place) + noise - noise.mean(0))


def run(made: CrossAttention, ball: Tokens, **others):
    tokens, role = person()
    roles = {"human": role, "ball": Role("object"), "box": Role("object"), "friend": role}
    return made({"human": tokens, "ball": ball, **others}, roles)


def part_of_joint() -> list[int]:
    """By name: SMPL-X's joints 1..21, then 15 of each hand."""
    names = (
        "left thigh", "right thigh", "belly", "left shin", "right shin", "belly", "left foot",
        "right foot", "chest", "left foot", "right foot", "head", "chest", "chest", "head",
        "left upper arm", "right upper arm", "left forearm", "right forearm", "left hand",
        "right hand", *("left hand",) * 15, *("right hand",) * 15,
    )  # fmt: skip
    return [PART_NAMES.index(name) for name in names]
