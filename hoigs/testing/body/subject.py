"""BodySubject: a body model with its settings, and poses."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.values.moment import BodyPose
from hoigs.testing.checks import CheckList
from hoigs.testing.material.clip import HUMAN, pose_at, tiny_clip
from hoigs.testing.modules import DeviceSubject

if TYPE_CHECKING:
    from hoigs.testing.runner import Options


class BodySubject(DeviceSubject[BodyModel]):
    """The component under check."""

    @cached_property
    def body(self) -> BodyModel:
        body = self.cls.from_config(self.config, BuildContext(HUMAN, tiny_clip()))
        return body.to(self.device)

    def pose(self, time: float = 0.3, dtype: torch.dtype = torch.float32) -> BodyPose:
        """Every joint rotated a little, a translation, and nonzero betas."""
        betas = 0.5 * torch.cos(torch.arange(self.body.num_betas, dtype=torch.float64))
        return pose_at(time).replace(betas=betas).to(self.device, dtype)

    def zero(self, dtype: torch.dtype = torch.float32) -> BodyPose:
        return BodyPose.zeros(betas=self.body.num_betas, dtype=dtype, device=self.device)


CHECKS: CheckList[BodySubject] = CheckList("B")


def subject(cls: type[BodyModel], config: Any, options: Options) -> BodySubject:
    made = BodySubject(cls, config, torch.device(options.device))
    made.body  # noqa: B018  (raises here when it cannot be built)
    return made
