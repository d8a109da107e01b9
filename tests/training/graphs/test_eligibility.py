"""What `cuda_graph_safe` declares, as far as a machine without CUDA can check it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from graphed_cases import FRAMES, VARIANTS, at, scene
from torch.overrides import TorchFunctionMode

from hoigs.core.fast.graphs import why_not_cuda_graph_safe
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.training.graphs import components_of

TENSOR = torch.Tensor
FROM_THE_HOST = {torch.tensor, torch.as_tensor, TENSOR.new_tensor}
TO_THE_HOST = {TENSOR.item, TENSOR.tolist, TENSOR.__bool__, TENSOR.__float__, torch.equal}


class NoHost(TorchFunctionMode):
    """Refuses tensors made from numbers, and numbers read from tensors."""

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        assert func not in FROM_THE_HOST, f"{func.__name__} copies numbers to the device"
        assert func not in TO_THE_HOST, f"{func.__name__} waits for the device"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_passes_between_host_and_device(variant: str) -> None:
    model = scene(**VARIANTS[variant])
    assert why_not_cuda_graph_safe(components_of(model)) is None
    moments = [replace(at(frame), time=torch.tensor(frame / (FRAMES - 1))) for frame in (1, 2)]
    model(moments[0])  # constants are made once
    with NoHost():
        model(moments[1])
        for name in model.entities:
            model.entity(name).regularizers()


def test_allcomponents_of_of_the_spec_hoigs_declare_it() -> None:
    for key in Spec.load("hoigs").components().values():
        if key.partition(":")[0] in ("deformation", "features", "interaction"):
            assert "cuda_graph_safe" in vars(default_registry().get(key)), key


def test_the_mode_finds_copies_in_both_directions() -> None:
    x = torch.ones(3)
    for wrong in (lambda: x * x.new_tensor((1.0, 2.0, 3.0)), lambda: float(x.sum()),
                  lambda: torch.tensor(1.0), lambda: bool(x.any())):  # fmt: skip
        with NoHost(), pytest.raises(AssertionError, match="the device"):
            wrong()
