"""The gsplat adapter where there is no GPU: what it refuses, and its work over a twin of gsplat.

With a GPU the conformance tests `-k gsplat-cuda` run it over gsplat itself.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import gsplat_twin
import pytest
import torch
from backends import declared
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.rasterizers import gsplat as adapter
from hoigs.rasterizers.gsplat import GsplatRasterizer
from hoigs.testing.checks import Check
from hoigs.testing.rasterizer import RasterizerSubject
from hoigs.testing.rasterizer.subject import a_camera, random_gaussians

pytestmark = pytest.mark.usefixtures("one_torch_thread")


class OverTwin(GsplatRasterizer):
    """The adapter, allowed to draw on the CPU."""

    capabilities = replace(GsplatRasterizer.capabilities, devices=frozenset({"cpu"}))


ON_CPU = RasterizerSubject(OverTwin(), torch.device("cpu"))


@pytest.mark.parametrize("check", [pytest.param(c, id=c.id) for c in declared(ON_CPU)])
def test_the_adapter_conforms_over_a_twin_of_gsplat(
    check: Check[RasterizerSubject], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "_import_gsplat", lambda: gsplat_twin)
    check.run(ON_CPU)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_cuda_device_it_says_so() -> None:
    with pytest.raises(RenderError, match=r"on CUDA only.*on cpu.*rasterizer:warp"):
        GsplatRasterizer().render(random_gaussians(3), a_camera())


def test_without_gsplat_it_has_the_pip_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(RenderError, match=r"pip install 'hoigs\[gsplat\]'"):
        OverTwin().render(random_gaussians(3), a_camera())


def test_gsplat_1_6_is_refused_with_the_pip_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def harmonics(degrees_to_use: int, means: Tensor, viewmats: Tensor, coeffs: Tensor) -> None:
        """With the parameters that it has since 1.6."""

    newer = SimpleNamespace(__version__="1.6.0", spherical_harmonics=harmonics)
    monkeypatch.setitem(sys.modules, "gsplat", newer)
    with pytest.raises(RenderError, match=r"1\.6\.0 is installed.*pip install 'gsplat<1\.6'"):
        OverTwin().render(random_gaussians(3), a_camera())


def test_constants_of_gsplat_cannot_be_changed() -> None:
    for name, value in (("max_alpha", 0.99), ("min_alpha", 0.0), ("min_transmittance", 0.0)):
        request = RenderRequest().replace(**{name: value})
        only = GsplatRasterizer.capabilities.fixed[name]
        with pytest.raises(RenderError, match=f"{name} is {value}.*{name} = {only}"):
            OverTwin().render(random_gaussians(3), a_camera(), request)


def test_listing_and_importing_it_loads_no_gsplat() -> None:
    code = (
        "import sys, hoigs.rasterizers.gsplat as m; m.GsplatRasterizer(); "
        "sys.exit('gsplat' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
