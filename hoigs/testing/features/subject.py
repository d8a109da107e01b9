"""FeaturesSubject: a class with its settings, bound to a motion that the kit makes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.context import BuildContext
from hoigs.core.entity import Entity
from hoigs.core.features import FeatureExtractor, Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.testing.checks import CheckList
from hoigs.testing.compare import require_close
from hoigs.testing.material.clip import OBJECT, moment_at, object_track, tiny_clip
from hoigs.testing.material.motion import TinyMotion
from hoigs.testing.modules import perturb, seeded

if TYPE_CHECKING:
    from hoigs.testing.door import Options

COUNT = 7
CPU = torch.device("cpu")
INSIDE = (0.0, 0.13, 0.5, 1.0)
OUTSIDE = (-0.2, 1.2)


@dataclass(frozen=True)
class FeaturesSubject:
    """What is checked: it describes an entity that sways."""

    cls: type[FeatureExtractor]
    config: Any
    device: torch.device = CPU

    def __str__(self) -> str:
        return self.cls.__name__

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
            rest = Gaussians.from_points(points, scales=0.02)
            return Entity(rest, TinyMotion(), features, kind="object")

        entity = seeded(make, seed)
        if perturbed:
            assert entity.features is not None
            perturb(entity.features)
        return entity.to(device=self.device, dtype=dtype).eval()

    def tokens(self, entity: Entity, time: float) -> Tokens:
        tokens = entity.tokens(moment_at(time, entity.means.dtype, entity.means.device))
        assert tokens is not None
        return tokens


CHECKS: CheckList[FeaturesSubject] = CheckList("F")


def subject(cls: type[FeatureExtractor], config: Any, options: Options) -> FeaturesSubject:
    made = FeaturesSubject(cls, config, torch.device(options.device))
    made.entity()
    return made


def by_name(tokens: Tokens) -> dict[str, Tensor]:
    return {"features": tokens.features, "positions": tokens.positions}


def require_same(what: str, got: Tokens, wanted: Tokens, atol: float = 1e-5) -> None:
    for name, x in by_name(wanted).items():
        require_close(f"{what}: {name}", by_name(got)[name], x, atol=atol)


def learns(subject: FeaturesSubject) -> str | None:
    features = subject.entity().features
    assert features is not None
    trained = any(p.requires_grad for p in features.parameters())
    return None if trained else "it has no parameters"
