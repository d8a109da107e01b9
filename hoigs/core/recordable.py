"""Which models may be recorded: their computation captured once, and replayed with other numbers.

A recording repeats the operations of one call, on the same memory. So a component may be recorded,
and says so by `recordable = True` in its own class, if in training mode

- the time, which comes as a 0-d tensor (`hoigs.core.clock`), and the values of parameters, buffers
  and poses are read on the device alone: no `float(x)`, `x.item()`, `if x > 0`, boolean indexing,
  and nothing made there from numbers of the host (`clock.constant` keeps such tensors);
- which operations are done depends on nothing that changes from step to step but shapes, or which
  tensors are parameters and buffers: not on `progress`, nor on a count of calls;
- nothing is random, and nothing is kept from one call for the next.

A subclass may break what its base promised, so it says it again, or is not recorded.
"""

from __future__ import annotations

from hoigs.core.scene import SceneModel


def why_not_recordable(model: SceneModel) -> str | None:
    """The first component that may not be recorded, in words; None if all may."""
    parts: list[tuple[str, object]] = [("interaction", model.interaction)]
    for name in model.entities:
        entity = model.entity(name)
        parts += [
            (f"{name}.deformation", entity.deformation),
            (f"{name}.features", entity.features),
        ]
    for place, part in parts:
        told = part is None or "recordable" in vars(type(part))
        if not told or not getattr(part, "recordable", True):
            return f"{place}, a {type(part).__name__}, is not recordable"
    return None
