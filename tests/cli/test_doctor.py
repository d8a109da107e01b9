"""`hoigs doctor`: each rasterizer draws on each device that it declares and the machine has."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.registry.manager import PluginManager
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.workflows.doctor import codec_rows, rasterizer_rows, training_row

PLUGIN = """
from hoigs import Component, hookimpl
from hoigs.core.interfaces.rasterizer import Capabilities, Rasterizer, RenderRequest
from hoigs.rasterizers.torch_tiles import TorchRasterizer


def capabilities(*devices):
    return Capabilities(frozenset(devices), frozenset({"float32"}), False, True)


class Good(TorchRasterizer):
    pass


class Cuda(TorchRasterizer):
    capabilities = capabilities("cuda")


class Broken(Rasterizer):
    capabilities = capabilities("cpu")

    def render(self, gaussians, camera, request=None):
        raise IndexError("no such tile")


class Black(TorchRasterizer):
    capabilities = capabilities("cpu")

    def render(self, gaussians, camera, request=None):
        return super().render(gaussians, camera, RenderRequest(max_alpha=0.5))


class Bare(Rasterizer):
    def render(self, gaussians, camera, request=None): ...


@hookimpl
def hoigs_components():
    for name in NAMES:
        yield Component(f"rasterizer:{name}", target=f"{__name__}:{name.title()}")
"""
OK = "ok: drew a test splat"


@pytest.fixture
def registry(tmp_path, monkeypatch):
    """Makes the registry that `hoigs doctor` sees, of the classes above that it is given."""

    def make(*names: str, more: str = "") -> Registry:
        path = tmp_path / "backends.py"
        path.write_text(PLUGIN.replace("NAMES", repr(names)) + more)
        manager = PluginManager({})
        manager.load_file(path)
        made = Registry(manager)
        monkeypatch.setattr("hoigs.core.registry.registry.default_registry", lambda: made)
        return made

    return make


@pytest.fixture
def no_cuda(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_a_backend_without_a_device_here_is_no_failure(hoigs, registry, no_cuda):
    rows = rasterizer_rows(registry("good", "cuda"))
    assert rows == [
        ("rasterizer:cuda", "not run: needs cuda", ""),
        ("rasterizer:good on cpu", OK, ""),
    ]
    outcome = hoigs("doctor")
    assert outcome.code == 0 and "not run: needs cuda" in outcome.out


def test_what_goes_wrong_is_a_row_and_not_a_traceback(hoigs, registry, no_cuda):
    names = ("bare", "black", "broken", "gone", "good")
    rows = {name: verdict for name, verdict, _ in rasterizer_rows(registry(*names))}
    assert rows.pop("rasterizer:bare").startswith("failed: AttributeError: ")
    assert rows.pop("rasterizer:black on cpu").startswith("wrong: test splat is [0.5, ")
    assert rows == {
        "rasterizer:broken on cpu": "failed: IndexError: no such tile",
        "rasterizer:gone": "failed",
        "rasterizer:good on cpu": OK,
    }


@pytest.mark.parametrize("name", ["bare", "black", "broken", "gone"])
def test_each_failure_ends_with_1(hoigs, registry, no_cuda, name):
    registry(name)
    outcome = hoigs("doctor")
    assert outcome.code == 1 and f"rasterizer:{name}" in outcome.out


def test_a_backend_whose_extra_is_absent_says_how_to_get_it(hoigs, registry, no_cuda):
    absent = (
        '\n@hookimpl(specname="hoigs_components")\n'
        "def more():\n"
        '    yield Component("rasterizer:extra", target="no_such_module:X", extra="quick")\n'
    )
    ((name, verdict, note),) = rasterizer_rows(registry(more=absent))
    assert (name, verdict) == ("rasterizer:extra", "not run: needs an extra")
    assert "pip install 'backends.py[quick]'" in note
    outcome = hoigs("doctor")
    assert outcome.code == 0 and "[quick]" in outcome.out


def test_a_training_step_and_the_codecs_of_films():
    row = training_row("cpu")
    assert row.ok and row.found == "ok" and "ms for 1000 Gaussians" in row.note
    assert {row.what: row.found for row in codec_rows()}["codec libx264"] == "ok"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_all_that_declare_it_draw_there(hoigs):
    rows = {name: verdict for name, verdict, _ in rasterizer_rows(default_registry())}
    for backend in ("warp", "torch", "oracle"):
        for device in ("cpu", "cuda"):
            assert rows[f"rasterizer:{backend} on {device}"] == OK
    gsplat = rows.get("rasterizer:gsplat", rows.get("rasterizer:gsplat on cuda"))
    assert gsplat in (OK, "not run: needs an extra")
    assert hoigs("doctor").code == 0
