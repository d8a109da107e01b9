"""interaction:none: every entity moves on its own (the paper's ablation "w/o HOI")."""

from __future__ import annotations

from collections.abc import Mapping

from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import Residual, Role, Tokens


class NoInteraction(InteractionModule):
    """No residuals."""

    cuda_graph_safe = True
    reads = False

    def forward(
        self, tokens: Mapping[str, Tokens], roles: Mapping[str, Role]
    ) -> Mapping[str, Residual]:
        del tokens, roles
        return {}
