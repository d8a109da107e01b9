"""BodySubject: a body model with its settings, and poses to put it in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch

from hoigs.core.body import BodyModel
from hoigs.core.context import BuildContext
from hoigs.core.moment import BodyPose
from hoigs.testing.checks import CheckList
from hoigs.testing.material.clip import HUMAN, pose_at, tiny_clip

if TYPE_CHECKING:
    from hoigs.testing.door import Options

CPU = torch.device("cpu")


@dataclass(frozen=True)
class BodySubject:
    """What is checked."""

    cls: type[BodyModel]
    config: Any
    device: torch.device = CPU

    def __str__(self) -> str:
        return self.cls.__name__

    @cached_property
    def body(self) -> BodyModel:
        body = self.cls.from_config(self.config, BuildContext(HUMAN, tiny_clip()))
        return body.to(self.device)

    def pose(self, time: float = 0.3, dtype: torch.dtype = torch.float32) -> BodyPose:
        """Every joint turned a little, the body away from the origin, some shape."""
        betas = 0.5 * torch.cos(torch.arange(self.body.num_betas, dtype=torch.float64))
        return pose_at(time).replace(betas=betas).to(self.device, dtype)

    def zero(self, dtype: torch.dtype = torch.float32) -> BodyPose:
        return BodyPose.zeros(betas=self.body.num_betas, dtype=dtype, device=self.device)


CHECKS: CheckList[BodySubject] = CheckList("B")


def subject(cls: type[BodyModel], config: Any, options: Options) -> BodySubject:
    made = BodySubject(cls, config, torch.device(options.device))
    made.body  # noqa: B018  (who cannot be made says why)
    return made
