"""Objective: a term of the training loss that a plugin brings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import PluginError
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame


@dataclass(frozen=True)
class TrainingMoment:
    """What is known of one training step before the loss is computed.

    Attributes:
        model: may be called at other moments, `model(moment)`; its gradients count.
        frame: the view, on the model's device. camera: its camera, refined where cameras are.
        state: all entities at `frame.moment`.
        generator: for random choices, CPU: a run is then repeatable.
    """

    model: SceneModel
    frame: Frame
    camera: Camera
    state: SceneState
    generator: torch.Generator


class Objective(Configurable, ABC):
    """A term of the loss, or several: `objectives: {NAME: {use: "objective:...", weight: ...}}`.

    In each step `channels` is called before the composite is drawn, and `terms` after it. An
    instance has no parameters; what `channels` finds out and `terms` needs may be kept on it for
    the length of a step. Data beyond the clip's come from files that the settings name.
    """

    def channels(self, at: TrainingMoment) -> Float[Tensor, "N F"] | None:
        """Further channels to draw with the composite, a row for each of `at.state.joined()`; None
        where there are none."""
        del at
        return None

    @abstractmethod
    def terms(
        self, at: TrainingMoment, drawn: RenderOutput, channels: Float[Tensor, "H W F"] | None
    ) -> Mapping[str, Float[Tensor, ""]]:
        """Losses by name, not weighted; none where this frame has none.

        Args:
            drawn: the composite of all entities. channels: accumulated, sum(w f), as
                `RenderOutput.features`; None where `channels` gave None.
        """


@dataclass(frozen=True)
class Weighted:
    """An objective, its name in the spec, and its weight."""

    name: str
    objective: Objective
    weight: float

    def channels(self, at: TrainingMoment) -> Float[Tensor, "N F"] | None:
        """The objective's channels.

        Raises:
            PluginError: they are not one row a Gaussian.
        """
        found, count = self.objective.channels(at), len(at.state.joined())
        if found is not None and (found.dim() != 2 or len(found) != count):
            raise PluginError(
                f"objective {self.name!r} ({type(self.objective).__name__}) gave channels "
                f"{list(found.shape)}, expected [{count}, F]: a row for each Gaussian"
            )
        return found

    def terms(
        self, at: TrainingMoment, drawn: RenderOutput, channels: Tensor | None
    ) -> dict[str, Tensor]:
        """The objective's losses, by `objective/NAME/TERM`.

        Raises:
            PluginError: a loss is not a single number.
        """
        found = {}
        for term, value in self.objective.terms(at, drawn, channels).items():
            if not isinstance(value, Tensor) or value.numel() != 1:
                shape = list(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise PluginError(
                    f"objective {self.name!r} ({type(self.objective).__name__}): term {term!r} is "
                    f"{shape}, expected a tensor of one number"
                )
            found[f"objective/{self.name}/{term}"] = value.reshape(())
        return found
