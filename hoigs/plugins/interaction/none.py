"""interaction:none: every entity moves on its own (the paper's ablation "w/o HOI")."""

from __future__ import annotations

from collections.abc import Mapping

from hoigs.core.config import ComponentConfig
from hoigs.core.features import Tokens
from hoigs.core.interaction import InteractionModule, Residual, Role


class NoInteractionConfig(ComponentConfig):
    """Nothing to set."""


class NoInteraction(InteractionModule):
    """No residuals."""

    recordable = True
    reads = False

    def forward(
        self, tokens: Mapping[str, Tokens], roles: Mapping[str, Role]
    ) -> Mapping[str, Residual]:
        del tokens, roles
        return {}
