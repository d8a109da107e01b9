"""Which components may be captured in a CUDA graph.

A replay repeats the operations of one call on the same memory. A component may be captured, and
declares so by `cuda_graph_safe = True` in its own class, if in training mode

- it reads the time, a 0-d tensor (`hoigs.core.cuda_graphs.device_constants`), and the values of
  parameters, buffers and poses on the device only: no `float(x)`, `x.item()`, `if x > 0` or boolean
  indexing, and no tensor made from Python numbers (`device_constants.constant` keeps those);
- its sequence of operations depends on nothing that changes from step to step, except shapes and
  which tensors are parameters or buffers: not on `progress`, nor on a count of calls;
- nothing is random, and no call keeps anything for the next one.

A subclass does not inherit the declaration, since an override may break these rules.
"""

from __future__ import annotations

from collections.abc import Mapping


def why_not_cuda_graph_safe(components: Mapping[str, object]) -> str | None:
    """Name the first component that may not be captured; None if all may.

    Args:
        components: by the name that the message uses; None stands for a component that is absent.
    """
    for name, component in components.items():
        declared = component is None or "cuda_graph_safe" in vars(type(component))
        if not declared or not getattr(component, "cuda_graph_safe", True):
            return f"{name}, a {type(component).__name__}, is not cuda_graph_safe"
    return None
