"""Cost of a training, in `study.json` of the run folder."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoigs.core.system.files import write_whole
from hoigs.evaluation.protocol import NotComputed, Value, from_json, to_json
from hoigs.studies.jobs.job import Job

if TYPE_CHECKING:
    from hoigs.training.session import Session


# Energy in joules: of an NVIDIA board by NVML, of CPU packages by RAPL.

POWERCAP = Path("/sys/class/powercap")
NVML = "GPU board, by NVML"
RAPL = "CPU packages, by RAPL; all that ran on them"


class EnergyMeter:
    """Sums energy counters, which wrap around at their range.

    Args:
        source: what is measured. read: joules by counter.
        ranges: joules at which a counter wraps around.

    `sample` must be called at least once in a range (RAPL: some tens of minutes).
    """

    def __init__(
        self,
        source: str,
        read: Callable[[], Mapping[str, float]],
        ranges: Mapping[str, float] | None = None,
    ) -> None:
        self.source, self._read, self._ranges = source, read, dict(ranges or {})
        self._last = dict(read())
        self.joules = 0.0

    def sample(self) -> None:
        now = dict(self._read())
        for name, value in now.items():
            spent = value - self._last[name]
            self.joules += spent + (self._ranges.get(name, 0.0) if spent < 0 else 0.0)
        self._last = now


def rapl_meter(root: Path = POWERCAP) -> EnergyMeter | NotComputed:
    """The counters of Linux for Intel and AMD CPUs, which only root can read on most systems."""
    if not root.is_dir():
        return NotComputed(f"this machine has no {root}, which reports the energy of the CPU")
    packages = [
        folder
        for folder in sorted(root.iterdir())
        if (folder / "energy_uj").exists()
        and (folder / "name").is_file()
        and (folder / "name").read_text().startswith("package")
    ]
    if not packages:
        return NotComputed(f"{root} has no counter of a CPU package")

    def read() -> dict[str, float]:
        return {f.name: int((f / "energy_uj").read_text()) * 1e-6 for f in packages}

    try:
        ranges = {f.name: int((f / "max_energy_range_uj").read_text()) * 1e-6 for f in packages}
        return EnergyMeter(RAPL, read, ranges)
    except PermissionError as error:
        return NotComputed(f"{error.filename} may be read by root only")


def nvml_meter(device: str) -> EnergyMeter | NotComputed:
    """The board's counter since its driver was loaded (Volta and later)."""
    try:
        import pynvml
    except ModuleNotFoundError:
        return NotComputed("no NVML for Python: pip install nvidia-ml-py")
    import torch

    try:
        pynvml.nvmlInit()
        uuid = str(torch.cuda.get_device_properties(device).uuid)
        handle = pynvml.nvmlDeviceGetHandleByUUID(f"GPU-{uuid.removeprefix('GPU-')}")
        return EnergyMeter(
            NVML, lambda: {uuid: pynvml.nvmlDeviceGetTotalEnergyConsumption(handle) * 1e-3}
        )
    except pynvml.NVMLError as error:
        return NotComputed(f"NVML: {error}")


def spent(meter: EnergyMeter | NotComputed) -> Value:
    """Joules since the meter was made, or why they are not known."""
    if isinstance(meter, NotComputed):
        return meter
    meter.sample()
    return meter.joules


# Peak memory of a training: what torch reserved on its GPU, or the process's resident memory.

STATUS = Path("/proc/self/status")
GPU = "most that PyTorch reserved on the GPU, captured graphs included, the CUDA context not"
CPU = "most of the process's resident memory, libraries included"


def start_peak(device: str) -> None:
    """Forget the GPU's peak until now; what is in use stays counted."""
    if device.startswith("cuda"):
        import torch

        torch.cuda.reset_peak_memory_stats(device)


def peak_memory(device: str, status: Path = STATUS) -> tuple[Value, str]:
    """Peak in MB (10^6 bytes), of the GPU since `start_peak`, and what that measures.

    The process's is the system's own (VmHWM): `getrusage` counts the parent's before exec, too.
    """
    if device.startswith("cuda"):
        import torch

        return torch.cuda.max_memory_reserved(device) / 1e6, GPU
    try:
        lines = status.read_text().splitlines()
    except OSError:
        return NotComputed(f"this system has no {status}, which reports the peak"), ""
    kib = next((line.split()[1] for line in lines if line.startswith("VmHWM:")), None)
    if kib is None:
        return NotComputed(f"{status} has no VmHWM"), ""
    return int(kib) * 1024 / 1e6, CPU


# Fingerprint of the machine that a number was measured on.

CPUINFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Machine:
    """What the duration of a training depends on.

    Attributes:
        cpu: model. cores: threads that torch computes with. gpu: name, None where none was used.
        torch, warp: versions.
    """

    cpu: str
    cores: int
    gpu: str | None
    torch: str
    warp: str

    @staticmethod
    def here(device: str) -> Machine:
        """This process on this machine, computing on `device`."""
        import torch

        gpu = torch.cuda.get_device_name(device) if device.startswith("cuda") else None
        cores = torch.get_num_threads()
        return Machine(cpu_model(), cores, gpu, torch.__version__, metadata.version("warp-lang"))

    @property
    def words(self) -> str:
        """The fingerprint as text."""
        cores = f"{self.cores} core{'s' if self.cores > 1 else ''}"
        where = f"{self.gpu}, with " if self.gpu else ""
        return f"{where}{self.cpu}, {cores}; torch {self.torch}, warp {self.warp}"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def cpu_model(cpuinfo: Path = CPUINFO) -> str:
    """As the system names it; the architecture where it names none."""
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return " ".join(value.split())
    return platform.processor() or platform.machine()


STUDY = "study.json"
OLD = "this run was made before costs were kept; delete its folder to train it again"
INTERRUPTED = "the training was interrupted, and what its lost part took is not known"
NO_MEMORY = "this run was made before peak memory was kept; delete its folder to train it again"


@dataclass(frozen=True)
class Cost:
    """Of one training.

    Attributes:
        train_s: seconds of all steps, checkpoints on the way included, previews and scoring not.
        joules: from the first step to the last, previews included, where nothing ran beside.
        source: what they measure.
        memory_mb: peak in MB, of the GPU where there is one; previews included.
        memory_source: what that measures.
        machines: fingerprint of each; more than one if the run was moved.
        runs_at_once: how many runs shared the machine, this one included.
    """

    train_s: Value
    joules: Value
    source: str
    memory_mb: Value
    memory_source: str
    machines: tuple[str, ...]
    runs_at_once: int


def train_measured(session: Session, job: Job, runs_at_once: int = 1) -> None:
    """Train to the end, and write the cost.

    The start of each part is written first, so that an interrupted part is known to be missing.
    """
    trainer, path = session.trainer, job.folder / STUDY
    parts = [p for p in read_study(job.folder)["parts"] if p["from_step"] < trainer.step]
    record: dict[str, Any] = {"job": json.loads(job.dump()), "parts": parts}
    if trainer.step < session.spec.train.steps:
        part: dict[str, Any] = {
            "from_step": trainer.step,
            "machine": Machine.here(job.device).to_dict(),
            "runs_at_once": runs_at_once,
        }
        parts.append(part)
        _write(path, record)
        start_peak(job.device)
        meter = nvml_meter(job.device) if job.device.startswith("cuda") else rapl_meter()
        session.train(lambda _: meter.sample() if isinstance(meter, EnergyMeter) else None)
        joules = spent(meter)
        part["to_step"] = trainer.step
        part["joules"] = to_json(joules)
        part["source"] = meter.source if isinstance(meter, EnergyMeter) else ""
        memory, part["memory_source"] = peak_memory(job.device)
        part["memory_mb"] = to_json(memory)
    record["train_s"] = trainer.elapsed
    _write(path, record)


def read_study(folder: Path) -> dict[str, Any]:
    """`study.json` of a run; without parts where there is none."""
    path = folder / STUDY
    return json.loads(path.read_text()) if path.is_file() else {"parts": []}


def read_cost(folder: Path) -> Cost:
    """Cost of a trained run; a number that is absent has its reason."""
    study = read_study(folder)
    parts = study["parts"]
    if "train_s" not in study:
        return Cost(NotComputed(OLD), NotComputed(OLD), "", NotComputed(OLD), "", (), 1)
    at_once = max((p["runs_at_once"] for p in parts), default=1)
    joules: Value = NotComputed(INTERRUPTED)
    if at_once > 1:
        joules = NotComputed(
            f"the meter counts all trainings of the machine, of which {at_once} ran"
        )
    elif len(parts) == 1 and "joules" in parts[0]:
        joules = from_json(parts[0]["joules"])
    return Cost(
        train_s=float(study["train_s"]),
        joules=joules,
        source=parts[-1].get("source", "") if parts and at_once == 1 else "",
        memory_mb=_most(parts) if parts else NotComputed(NO_MEMORY),
        memory_source=parts[-1].get("memory_source", "") if parts else "",
        machines=tuple(dict.fromkeys(Machine(**p["machine"]).words for p in parts)),
        runs_at_once=at_once,
    )


def _most(parts: Sequence[Mapping[str, Any]]) -> Value:
    """The highest peak of all parts."""
    unknown = to_json(NotComputed(NO_MEMORY))
    values = [from_json(part.get("memory_mb", unknown)) for part in parts]
    reasons = [v for v in values if isinstance(v, NotComputed)]
    if reasons:
        return NotComputed(INTERRUPTED) if len(parts) > 1 else reasons[0]
    return max(v for v in values if not isinstance(v, NotComputed))


def _write(path: Path, record: dict[str, Any]) -> None:
    write_whole(path, json.dumps(record, indent=1, allow_nan=False))
