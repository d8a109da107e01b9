"""What a captured graph of a model depends on."""

from __future__ import annotations

from hoigs.core.model.scene import SceneModel
from hoigs.core.values.moment import Moment
from hoigs.core.values.moment_layout import MomentLayout


class GraphKey:
    """The memory, shape and `requires_grad` of all tensors of a model, and the layout of moments.

    A graph that was captured when this key was made may be replayed as long as `holds` is True.

    Attributes:
        layout: of moments with these people.
        structure: the operations that are captured, whatever the shapes. Two keys of one model
            with equal structure need only one comparison of the graph with eager execution.
    """

    def __init__(self, model: SceneModel, moment: Moment) -> None:
        self._interaction_enabled = model.interaction_enabled
        self.layout = MomentLayout.of(moment, model.entities, betas=True)
        stores = [s for m in model.modules() for s in (m._parameters, m._buffers)]
        self._sizes = [(store, len(store)) for store in stores if store]
        # the detached tensors keep the memory allocated, so that no other tensor can take its place
        self._tensors = [
            (store, name, x, None if x is None else x.detach(), x is not None and x.requires_grad)
            for store in stores
            for name, x in store.items()
        ]
        people = tuple((name, p.convention) for name, p in self.layout.people.items())
        kinds = tuple((name, x is None, trained) for _, name, x, _, trained in self._tensors)
        self.structure = (self._interaction_enabled, people, kinds)

    def holds(self, model: SceneModel, moment: Moment) -> bool:
        """Whether nothing has changed since this key was made."""
        if model.interaction_enabled != self._interaction_enabled or not self.layout.fits(moment):
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
