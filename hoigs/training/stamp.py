"""What a recording of a model holds for, so that one sees when it no longer does."""

from __future__ import annotations

from hoigs.core.moment import Moment
from hoigs.core.moment_layout import MomentLayout
from hoigs.core.scene import SceneModel


class Stamp:
    """Memory and kind of all of a model's tensors, the parts in use, and who is there.

    Attributes:
        layout: of moments with these people.
        parts: what is computed, whatever the shapes; equal for stamps of which one recording's
            agreement with the plain path speaks for the other's.
    """

    def __init__(self, model: SceneModel, moment: Moment) -> None:
        self._enabled = model.interaction_enabled
        self.layout = MomentLayout.of(moment, model.entities, betas=True)
        stores = [s for m in model.modules() for s in (m._parameters, m._buffers)]
        self._sizes = [(store, len(store)) for store in stores if store]
        # detached, which keeps the memory: no other tensor can come to stand at the same address
        self._tensors = [
            (store, name, x, None if x is None else x.detach(), x is not None and x.requires_grad)
            for store in stores
            for name, x in store.items()
        ]
        people = tuple((name, p.convention) for name, p in self.layout.people.items())
        kinds = tuple((name, x is None, trained) for _, name, x, _, trained in self._tensors)
        self.parts = (self._enabled, people, kinds)

    def holds(self, model: SceneModel, moment: Moment) -> bool:
        """Whether all of it is still so."""
        if model.interaction_enabled != self._enabled or not self.layout.fits(moment):
            return False
        if any(len(store) != size for store, size in self._sizes):
            return False
        for store, name, tensor, memory, trained in self._tensors:
            if store.get(name) is not tensor:
                return False
            if tensor is not None and memory is not None:
                same = tensor.data_ptr() == memory.data_ptr() and tensor.shape == memory.shape
                if not same or tensor.requires_grad != trained:
                    return False
        return True
