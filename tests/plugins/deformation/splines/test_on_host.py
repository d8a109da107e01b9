"""What is worked on elsewhere comes back: the same memory where nothing changed."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from hoigs.core.parameters import on_host


class Part(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.kept, self.changed = nn.Parameter(torch.randn(3)), nn.Parameter(torch.randn(3, 2))
        self.register_buffer("tried", torch.arange(4.0))
        self.register_buffer("placed", torch.arange(4.0))
        self.register_buffer("nothing", None)
        self.register_parameter("none", None)


@pytest.fixture(params=["cpu", "copied", pytest.param("cuda", marks=pytest.mark.gpu)])
def module(request, monkeypatch) -> nn.Module:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if request.param == "copied":  # as if the tensors were of another device
        monkeypatch.setattr(torch.Tensor, "cpu", torch.Tensor.clone)
    torch.manual_seed(0)
    device = "cuda" if request.param == "cuda" else "cpu"
    return nn.ModuleDict({"part": Part()}).to(device)


@pytest.mark.parametrize("fails", [False, True])
def test_what_changes_comes_back_and_the_rest_is_the_same_memory(module, fails):
    part = module["part"]
    device = part.kept.device
    before = {name: (t.data_ptr(), t.clone()) for name, t in module.state_dict().items()}
    parameters = dict(module.named_parameters())

    def work() -> None:
        with on_host(module):
            assert {t.device.type for t in module.state_dict().values()} == {"cpu"}
            part.changed.data = torch.ones(5, 2)
            part.tried = torch.zeros(2)
            part.tried = torch.arange(4.0)  # as it was
            part.placed = torch.tensor([0.0, 1.0])
            if fails:
                raise KeyError("in between")

    if fails:
        with pytest.raises(KeyError):
            work()
    else:
        work()
    assert dict(module.named_parameters()) == parameters  # the same objects: optimizers know them
    after = module.state_dict()
    assert {t.device for t in after.values()} == {device}
    for name in ("part.kept", "part.tried"):
        assert after[name].data_ptr() == before[name][0]
        assert torch.equal(after[name], before[name][1])
    assert torch.equal(after["part.changed"].cpu(), torch.ones(5, 2))
    assert torch.equal(after["part.placed"].cpu(), torch.tensor([0.0, 1.0]))
