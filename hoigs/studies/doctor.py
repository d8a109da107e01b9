"""doctor and bug_report: versions, devices and rasterizers of this machine, and a zip of them."""

from __future__ import annotations

import getpass
import io
import json
import os
import re
import shutil
import socket
import subprocess
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import torch

import hoigs
from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.registry.manager import Offer, Status
from hoigs.core.registry.registry import Registry, default_registry, known_environments
from hoigs.core.system.files import written_whole
from hoigs.core.system.safe_replace import refuse_unwritable
from hoigs.core.system.threads import available_cpus
from hoigs.core.system.video_files import ENCODERS, pyav
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.metrics.lpips import find_weights
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.runs.run_folder import RunFolder, versions

DRIVER = Path("/proc/driver/nvidia/version")
LEFT_OUT = 0.02  # what a picture may differ by, since splats are not drawn where they are faint
NEEDS_EXTRA = "not run: needs an extra"
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
    """Check the installation; a check that fails is a row, and the others go on."""
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    checks: dict[str, Callable[[], list[Inspected]]] = {
        "versions": lambda: [Inspected(name, version) for name, version in versions().items()],
        "cpu": lambda: [threads_row()],
        "disk": lambda: [disk_row()],
        "cuda": cuda_rows,
        "rasterizers": lambda: rasterizer_rows(default_registry()),
        "training steps": lambda: [training_row(device) for device in devices],
        "codecs": codec_rows,
        "environments": environment_rows,
        "LPIPS weights": lambda: [weights_row()],
    }
    rows = []
    for name, check in checks.items():
        try:
            rows += check()
        except Exception as error:  # reported as the state of what was checked
            rows.append(Inspected(name, _failed(error)))
    return rows


def threads_row() -> Inspected:
    """Threads, and how they wait for each other."""
    threads = f"{torch.get_num_threads()} torch threads for {available_cpus()} processors"
    waiting = [
        f"{name}={os.environ[name]}"
        for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
        if name in os.environ
    ]
    return Inspected("cpu", "ok", "; ".join([threads, *waiting]))


def disk_row() -> Inspected:
    """Room on the disk of the working directory."""
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    return Inspected("disk", "ok" if free > 1 else "failed: nearly full", f"{free:.1f} GB")


def cuda_rows() -> list[Inspected]:
    """NVIDIA's driver, and whether this torch uses it."""
    driver, usable = driver_version(), torch.cuda.is_available()
    rows = [Inspected("NVIDIA driver", driver or "none")]
    if usable:
        built = f"{torch.cuda.get_device_name(0)}; torch is built for CUDA {torch.version.cuda}"
        return [*rows, Inspected("cuda", "ok", built)]
    if not driver:
        return [*rows, Inspected("cuda", "none", "everything runs on the CPU")]
    if torch.version.cuda is None:
        without = f"torch {torch.__version__} is built without CUDA"
        return [*rows, Inspected("cuda", "none", f"{without}; install one with it to use the GPU")]
    note = f"it is built for CUDA {torch.version.cuda}, which may need a newer driver"
    return [*rows, Inspected("cuda", "failed: torch cannot use the driver", note)]


def driver_version() -> str:
    """The version of NVIDIA's driver; "" without one."""
    try:
        text = DRIVER.read_text(encoding="utf-8")
    except OSError:  # another system than Linux, or no driver
        program = shutil.which("nvidia-smi")
        if program is None:
            return ""
        command = [program, "--query-gpu=driver_version", "--format=csv,noheader"]
        asked = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
        text = asked.stdout
    found = re.search(r"\b\d{3,}(\.\d+)+\b", text)
    return found.group() if found else ""


def environment_rows() -> list[Inspected]:
    """The environments that estimators run in."""
    rows = []
    for environment in known_environments().values():
        state = environment.description().get("versions") or "not installed"
        lacks = "; ".join(f"lacks {name}: {why}" for name, why in environment.lacking().items())
        rows.append(Inspected(f"environment {environment.name}", str(state), lacks))
    return rows


def weights_row() -> Inspected:
    """The network of LPIPS."""
    weights = find_weights()
    return Inspected("LPIPS weights", weights.location or "none", weights.reason)


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
    try:
        av = pyav()
    except HoigsError as error:
        return [Inspected("videos", "none", str(error))]
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
        found = NEEDS_EXTRA if absent else "failed"
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
    """Draw a few Gaussians on a device: the state by the oracle's picture, and the report."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2.0])
    colors = torch.rand(20, 3, generator=generator)
    gaussians = Gaussians.from_points(points, colors, scales=0.1, opacity=0.9)
    K = torch.tensor([[32.0, 0, 12], [0, 32.0, 12], [0, 0, 1]])
    camera = Camera(K, torch.eye(4), 24, 24)
    truth = OracleRasterizer().render(gaussians, camera).color
    try:
        rasterizer = backend()
        color = rasterizer.render(gaussians.to(device), camera.to(device)).color.cpu()
        report: dict[str, str] = getattr(rasterizer, "backend_report", dict)()
        error = float((color - truth).abs().max())
    except Exception as problem:  # reported as the backend's state
        if isinstance(problem.__cause__, ImportError):  # imported on use: gsplat's
            return NEEDS_EXTRA, str(problem)
        return _failed(problem), ""
    note = ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in report.items())
    if error < LEFT_OUT:
        return "ok: draws as the oracle does", note
    return f"wrong: its picture differs from the oracle's by {error:.3f}", note


# bug_report: what helps to find a fault, in a zip without pictures, names of users or paths.

OF_A_RUN = ("spec.yaml", "provenance.json", "metrics.jsonl", "evaluation.json")
MOST_BYTES = 20 * 2**20  # of one file; a longer one is cut at its beginning
PATH = re.compile(r"(?<![\w.<])(?:[A-Za-z]:\\|~?/|(?:\.\./)+)(?:[^\s\"',:;<>|*?]+[/\\])+")


def bug_report(
    run: Path | str | None = None, *, out: Path | str = "hoigs-bug-report.zip"
) -> dict[str, int]:
    """Write a zip with the results of `doctor`, all plugins, and the text files of a run.

    Images, masks, weights and clips stay out. Folders, the names of the user and of the machine are
    replaced in every text.

    Args:
        run: a run folder, complete or not.

    Returns:
        The files in the zip and their sizes, bytes.

    Raises:
        HoigsError: `out` exists, or `run` is no folder.
    """
    out, texts = Path(out), {}
    if out.exists():
        raise HoigsError(f"{out}: already exists; name another file: --out FILE")
    refuse_unwritable(out)
    rows = [row._asdict() | {"ok": row.ok} for row in doctor()]
    texts["doctor.json"] = json.dumps({"hoigs": hoigs.__version__, "rows": rows}, indent=1)
    texts["plugins.txt"] = _plugins()
    if run is not None:
        texts |= _of_run(Path(run))
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(name, without_names(text))
    with written_whole(out) as part:
        part.write_bytes(made.getvalue())
    return {name: len(text.encode()) for name, text in texts.items()}


def _plugins() -> str:
    manager = default_registry().manager
    lines = [f"{p.name} {p.dist} {p.version}: {p.status} {p.error}" for p in manager.plugins]
    lines += [f"{o.exact}: {o.status} {o.error}" for o in manager.offers if o.status != "ok"]
    return "\n".join([*lines, *manager.notes])


def _of_run(path: Path) -> dict[str, str]:
    if not path.is_dir():
        raise HoigsError(f"{path}: no such folder")
    texts = {}
    for name in OF_A_RUN:
        if (path / name).is_file():
            data = (path / name).read_bytes()[-MOST_BYTES:]
            texts[f"run/{name}"] = data.decode("utf-8", "replace")
    folder = RunFolder(path).checkpoints
    listed = sorted(folder.iterdir()) if folder.is_dir() else []
    texts["run/checkpoints.txt"] = "\n".join(f"{p.name} {p.stat().st_size}" for p in listed)
    return texts


def without_names(text: str) -> str:
    """`text` with FOLDER/ for folders, and without the names of user and machine."""
    text = PATH.sub("FOLDER/", text)
    private = {_user(): "USER", socket.gethostname(): "MACHINE", Path.home().name: "USER"}
    for name, word in private.items():
        if len(name) > 2 and name != "root":
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", word, text)
    return text


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return ""
