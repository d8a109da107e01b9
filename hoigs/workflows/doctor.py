"""doctor: versions and devices of this machine, and whether each rasterizer works on it."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path
from typing import Literal, NamedTuple

import torch

from hoigs.core.errors import PluginError
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.machine.cpus import available_cpus
from hoigs.core.registry.manager import Offer, Status
from hoigs.core.registry.registry import Registry
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.metrics.lpips import find_weights
from hoigs.runs.run_folder import versions

DECODERS = ("h264", "hevc", "vp9", "av1", "mjpeg")


class Inspected(NamedTuple):
    """One row of `doctor`'s report.

    Attributes:
        what: a package, a device or a component. found: its version or state.
    """

    what: str
    found: str
    note: str = ""

    @property
    def ok(self) -> bool:
        """False if it is installed and does not work."""
        return not self.found.startswith(("failed", "wrong"))


def doctor() -> list[Inspected]:
    """Check the installation: versions, devices, rasterizers, video codecs, LPIPS weights."""
    from hoigs.core.registry.environments import known_environments
    from hoigs.core.registry.registry import default_registry

    rows = [Inspected(name, version) for name, version in versions().items()]
    rows += [*_devices(), *rasterizer_rows(default_registry())]
    rows += [training_row(d) for d in ("cpu", "cuda") if d == "cpu" or torch.cuda.is_available()]
    rows += codec_rows()
    for environment in known_environments().values():
        state = environment.description().get("versions") or "not installed"
        lacks = "; ".join(f"lacks {name}: {why}" for name, why in environment.lacking().items())
        rows.append(Inspected(f"environment {environment.name}", str(state), lacks))
    weights = find_weights()
    return [*rows, Inspected("LPIPS weights", weights.location or "none", weights.reason)]


def _devices() -> list[Inspected]:
    threads = f"{torch.get_num_threads()} torch threads for {available_cpus()} processors"
    waiting = [
        f"{name}={os.environ[name]}"
        for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
        if name in os.environ
    ]
    rows = [Inspected("cpu", "ok", "; ".join([threads, *waiting]))]
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    rows.append(Inspected("disk", "ok" if free > 1 else "failed: nearly full", f"{free:.1f} GB"))
    if torch.cuda.is_available():
        rows.append(Inspected("cuda", "ok", torch.cuda.get_device_name(0)))
    else:
        rows.append(Inspected("cuda", "none", "everything runs on the CPU"))
    return rows


def training_row(device: str) -> Inspected:
    """Drawing 1000 Gaussians with rasterizer:warp, gradients and an optimiser's step, timed."""
    from hoigs.rasterizers.warp import WarpRasterizer

    def step() -> None:
        loss = rasterizer.render(gaussians, camera).color.square().mean()
        loss.backward()
        optimiser.step()
        float(loss.detach())  # waits for the device

    try:
        points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) + 1
        gaussians = Gaussians.from_points(points, points / 2, scales=0.05, opacity=0.5)
        gaussians = gaussians.to(device).map(lambda x: x.detach().clone().requires_grad_())
        K = torch.tensor([[64.0, 0, 0], [0, 64.0, 0], [0, 0, 1]])
        camera = Camera(K, torch.eye(4), 64, 64).to(device)
        rasterizer = WarpRasterizer()
        optimiser = torch.optim.Adam([gaussians.means, gaussians.sh])
        before = gaussians.means.detach().clone()
        step()  # compiles kernels, or loads them
        began = time.perf_counter()
        step()
        spent = 1000 * (time.perf_counter() - began)
    except Exception as error:  # reported as the device's state
        return Inspected(f"training step on {device}", _failed(error))
    if torch.equal(before, gaussians.means):
        return Inspected(f"training step on {device}", "wrong: no Gaussian moved")
    return Inspected(f"training step on {device}", "ok", f"{spent:.1f} ms for 1000 Gaussians")


def codec_rows() -> list[Inspected]:
    """The encoders that films need, and the decoders of usual videos, in this build of PyAV."""
    import av

    from hoigs.core.video_files import ENCODERS

    rows = []
    wanted: list[tuple[str, Literal["r", "w"], str]]
    wanted = [(encoder[0], "w", ending) for ending, encoder in ENCODERS.items()]
    wanted += [(name, "r", "reading") for name in DECODERS]
    for name, mode, use in wanted:
        try:
            av.Codec(name, mode)
        except Exception:  # PyAV's own classes of errors differ by version
            rows.append(Inspected(f"codec {name}", "none", f"{use} does not work"))
        else:
            rows.append(Inspected(f"codec {name}", "ok", use))
    return rows


def rasterizer_rows(registry: Registry) -> list[Inspected]:
    """One row for each rasterizer and each of its devices that this machine has."""
    shown = (Status.OK, Status.NEEDS_EXTRA)
    offers = [o for o in registry.manager.offers if o.component.kind == "rasterizer"]
    offers = sorted((o for o in offers if o.status in shown), key=lambda offer: offer.key)
    return [row for offer in offers for row in _rows_of(offer, registry)]


def _rows_of(offer: Offer, registry: Registry) -> list[Inspected]:
    try:
        backend = registry.get(offer.exact)
        declared = sorted(backend.capabilities.devices)
    except PluginError:
        absent = offer.status is Status.NEEDS_EXTRA
        found = "not run: needs an extra" if absent else "failed"
        return [Inspected(offer.key, found, offer.error)]
    except Exception as error:  # a plugin's class may raise anything here
        return [Inspected(offer.key, _failed(error), "capabilities.devices could not be read")]
    present = {"cpu"} | ({"cuda"} if torch.cuda.is_available() else set())
    devices = [device for device in declared if device in present]
    if not devices:
        return [Inspected(offer.key, f"not run: needs {' or '.join(declared)}")]
    return [Inspected(f"{offer.key} on {device}", *_draw(backend, device)) for device in devices]


def _failed(error: Exception) -> str:
    return f"failed: {type(error).__name__}: {error}"


def _draw(backend: type[Rasterizer], device: str) -> tuple[str, str]:
    """Draw one Gaussian on a device: the state by its middle pixel, and the backend's report."""
    points = torch.tensor([[0.0, 0.0, 2.0]])
    red = Gaussians.from_points(points, torch.tensor([[1.0, 0.0, 0.0]]), scales=0.2, opacity=0.9)
    K = torch.tensor([[32.0, 0, 8.5], [0, 32.0, 8.5], [0, 0, 1]])
    camera = Camera(K, torch.eye(4), 17, 17)
    try:
        rasterizer = backend()
        output = rasterizer.render(red.to(device), camera.to(device))
        middle = output.color[8, 8].tolist()
        report: dict[str, str] = getattr(rasterizer, "backend_report", dict)()
    except Exception as error:  # reported as the backend's state
        return _failed(error), ""
    note = ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in report.items())
    if max(abs(value - truth) for value, truth in zip(middle, (0.9, 0, 0), strict=True)) < 1e-3:
        return "ok: drew a test splat", note
    return f"wrong: test splat is {middle}, expected [0.9, 0, 0]", note
