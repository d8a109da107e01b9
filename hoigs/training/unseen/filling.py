"""When, in a training, what no frame shows is filled in."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import TrainSpec
from hoigs.core.values.clip import Clip
from hoigs.training.unseen.fill import fill_unseen
from hoigs.training.unseen.hidden_scene import spare_hidden


class Filling:
    """Fills in people and objects after shares of their own steps, and scenes after shares of all.

    Args:
        settled: step after which people and objects no longer change.

    Attributes:
        hidden: of each scene that hides in part, how much of its Gaussians is kept.
    """

    def __init__(self, spec: TrainSpec, settled: int) -> None:
        self.opposite = spec.unseen_sides == "opposite"
        self.settled, self.steps = settled, spec.steps
        self._own, self._scenes = (
            {max(1, round(share * steps)) for share in spec.fill_unseen}
            for steps in (settled, spec.steps)
        )
        self.hidden: dict[str, Float[Tensor, " N"]] = {}

    def spare(self, model: SceneModel) -> None:
        """Scale gradients of hidden Gaussians, before a step of the optimizer."""
        spare_hidden(model, self.hidden)

    def after(self, step: int, model: SceneModel, clip: Clip) -> None:
        """Fill in what is due after a step."""
        own, scenes = step in self._own, step in self._scenes
        if not own and not scenes:
            return
        shapes = step < (self.settled if own else self.steps)
        found = fill_unseen(
            model, clip, shapes=shapes, opposite=self.opposite, own=own, scenes=scenes
        )
        if scenes:
            self.hidden = found
