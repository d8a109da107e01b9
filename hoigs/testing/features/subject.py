"""FeaturesSubject: an extractor with its settings, on an entity with a synthetic motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.tokens import Tokens
from hoigs.testing.checks import CheckList
from hoigs.testing.compare import require_close
from hoigs.testing.material.clip import OBJECT, moment_at, object_track, tiny_clip
from hoigs.testing.material.motion import TinyMotion
from hoigs.testing.modules import DeviceSubject, perturb, seeded

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

COUNT = 7
INSIDE = (0.0, 0.13, 0.5, 1.0)
OUTSIDE = (-0.2, 1.2)


class FeaturesSubject(DeviceSubject[FeatureExtractor]):
    """The component under check; it describes an entity that moves."""

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


def require_same(what: str, got: Tokens, expected: Tokens, atol: float = 1e-5) -> None:
    for name, x in by_name(expected).items():
        require_close(f"{what}: {name}", by_name(got)[name], x, atol=atol)


def learns(subject: FeaturesSubject) -> str | None:
    features = subject.entity().features
    assert features is not None
    trained = any(p.requires_grad for p in features.parameters())
    return None if trained else "it has no parameters"
