"""A trained model with its spec, and the same model composed anew under a smaller spec."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hoigs.core.model.compose import compose
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.studies.needs.search_space import as_settings


@dataclass(frozen=True)
class Trained:
    """Input and result of pruning.

    Attributes:
        clip: at training width. model: in eval mode, at the end of its training.
    """

    spec: Spec
    model: SceneModel
    clip: Clip
    registry: Registry

    def blocks(self) -> dict[str, list[str]]:
        """Entities of the model by key of their block in the spec."""
        found: dict[str, list[str]] = {}
        for name in self.model.entities:
            block = self.spec.block(name, self.model.entity(name).kind)
            assert block is not None  # it was composed from this spec
            found.setdefault(block[0], []).append(name)
        return found

    def recomposed(
        self, overrides: Mapping[str, Any], changed: Mapping[str, Tensor] | None = None
    ) -> Trained:
        """The same model composed anew under another spec.

        Args:
            overrides: of the spec. changed: tensors that replace those of the model, by name.
                Tensors that the new model does not have are dropped.

        Raises:
            KeyError: the new model needs a tensor that neither has.
        """
        spec = overridden(self.spec, overrides, self.registry)
        model = compose(spec, self.clip, self.registry).to(self.model.device)
        for name in model.entities:
            model.entity(name).resize(len(self.model.entity(name)))
        state = self.model.state_dict() | dict(changed or {})
        missing = [key for key in model.state_dict() if key not in state]
        if missing:
            raise KeyError(f"the model with {', '.join(overrides)} lacks {', '.join(missing)}")
        model.load_state_dict({key: state[key] for key in model.state_dict()})
        model.eval()
        model.set_progress(1.0)
        return replace(self, spec=spec, model=model)


def overridden(spec: Spec, overrides: Mapping[str, Any], registry: Registry) -> Spec:
    """A spec with some keys set anew, name and summary kept."""
    with tempfile.TemporaryDirectory(prefix="hoigs-spec-") as folder:
        path = Path(folder) / "spec.yaml"
        path.write_text(spec.dump(), encoding="utf-8")
        return Spec.load(path, overrides=as_settings(overrides), registry=registry)


def state_prefix(entity: str) -> str:
    """How an entity's tensors are named in the model's state."""
    return f"entities.{entity}."


def cloned(tensor: Tensor) -> Tensor:
    with torch.no_grad():
        return tensor.detach().clone()
