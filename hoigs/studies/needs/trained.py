"""A trained model with its spec, and the same model under a spec that asks for less of it."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hoigs.core.clip import Clip
from hoigs.core.compose import compose
from hoigs.core.registry import Registry
from hoigs.core.scene import SceneModel
from hoigs.core.spec import Spec
from hoigs.studies.needs.rungs import as_settings


@dataclass(frozen=True)
class Trained:
    """What pruning starts from and ends with.

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

    def asking_less(
        self, overrides: Mapping[str, Any], changed: Mapping[str, Tensor] | None = None
    ) -> Trained:
        """The same model composed anew under another spec.

        Args:
            overrides: of the spec. changed: by name in the model's state, tensors that are not to
                be taken as they are. What the new model has no place for is left behind.

        Raises:
            KeyError: the new model asks for a tensor that there is not.
        """
        spec = overridden(self.spec, overrides, self.registry)
        model = compose(spec, self.clip, self.registry).to(self.model.device)
        for name in model.entities:
            model.entity(name).resize(len(self.model.entity(name)))
        state = self.model.state_dict() | dict(changed or {})
        missing = [key for key in model.state_dict() if key not in state]
        if missing:
            raise KeyError(f"the model of {', '.join(overrides)} asks for {', '.join(missing)}")
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
