"""`hoigs doctor`: each rasterizer draws on each device that it declares and the machine has."""

from __future__ import annotations

import json

import pytest
import torch

from hoigs.core.errors import RenderError
from hoigs.core.registry.manager import PluginManager
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.studies.doctor import (
    _draw,
    codec_rows,
    cuda_rows,
    driver_version,
    rasterizer_rows,
    training_row,
)

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
OK = "ok: draws as the oracle does"


@pytest.fixture
def registry(tmp_path, monkeypatch):
    """Makes the registry that `hoigs doctor` sees, of the classes above that it is given."""

    def make(*names: str, more: str = "") -> Registry:
        path = tmp_path / "backends.py"
        path.write_text(PLUGIN.replace("NAMES", repr(names)) + more)
        manager = PluginManager({})
        manager.load_file(path)
        made = Registry(manager)
        monkeypatch.setattr("hoigs.studies.doctor.default_registry", lambda: made)
        return made

    return make


@pytest.fixture
def no_cuda(monkeypatch, tmp_path):
    """A machine without NVIDIA's driver."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("hoigs.studies.doctor.DRIVER", tmp_path / "none")
    monkeypatch.setattr("hoigs.studies.doctor.shutil.which", lambda program: None)


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
    assert rows.pop("rasterizer:black on cpu").startswith(
        "wrong: its picture differs from the oracle's by 0."
    )
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


@pytest.mark.parametrize("name", ["versions", "cuda_rows", "codec_rows", "find_weights"])
def test_a_check_that_fails_costs_only_itself(hoigs, registry, no_cuda, monkeypatch, name):
    def fail():
        raise OSError("broken pipe")

    registry("good")
    whole = len(json.loads(hoigs("doctor", "--json").out))
    monkeypatch.setattr(f"hoigs.studies.doctor.{name}", fail)
    outcome = hoigs("doctor", "--json")
    rows = json.loads(outcome.out)
    assert outcome.code == 1 and len(rows) > whole / 2
    assert [row["found"] for row in rows if not row["ok"]] == ["failed: OSError: broken pipe"]


@pytest.mark.parametrize("kind", ["", " Open"])
def test_the_driver_of_a_machine_whose_torch_has_no_cuda(monkeypatch, no_cuda, tmp_path, kind):
    version = tmp_path / "version"
    version.write_text(
        f"NVRM version: NVIDIA UNIX{kind} Kernel Module for x86_64  560.35.03  Rel\n"
    )
    monkeypatch.setattr("hoigs.studies.doctor.DRIVER", version)
    monkeypatch.setattr(torch.version, "cuda", None)
    driver, cuda = cuda_rows()
    assert driver == ("NVIDIA driver", "560.35.03", "") and cuda.found == "none"
    assert "built without CUDA" in cuda.note
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert not cuda_rows()[1].ok


def test_the_driver_by_nvidia_smi(monkeypatch, tmp_path):
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 570.133.20\n")
    program.chmod(0o755)
    monkeypatch.setattr("hoigs.studies.doctor.DRIVER", tmp_path / "absent")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert driver_version() == "570.133.20"
    program.unlink()
    assert driver_version() == ""


def test_all_that_is_checked(hoigs, no_cuda):
    rows = {row["what"]: row for row in json.loads(hoigs("doctor", "--json").out)}
    assert {"torch", "python", "machine", "cpu", "disk", "NVIDIA driver", "cuda",
            "LPIPS weights", "environment mediapipe", "codec h264",
            "rasterizer:warp on cpu", "training step on cpu"} <= set(rows)  # fmt: skip
    assert "torch threads for" in rows["cpu"]["note"] and "GB" in rows["disk"]["note"]


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


class ImportsOnUse(OracleRasterizer):
    def render(self, *arguments, **named):
        raise RenderError("pip install 'hoigs[absent]'") from ImportError("no module")


def test_an_extra_that_is_imported_on_use_is_no_failure():
    found, note = _draw(ImportsOnUse, "cpu")
    assert found == "not run: needs an extra" and "hoigs[absent]" in note
