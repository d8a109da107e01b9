"""Energy in joules: of an NVIDIA board by NVML, of CPU packages by RAPL."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from hoigs.evaluation.protocol import NotComputed, Value

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


def energy_meter(device: str) -> EnergyMeter | NotComputed:
    """A meter of the GPU board for "cuda", else of the CPU packages."""
    return nvml_meter(device) if device.startswith("cuda") else rapl_meter()


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
