"""Fingerprint of the machine that a number was measured on."""

from __future__ import annotations

import platform
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

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
