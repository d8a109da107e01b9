"""Peak memory of a training: what torch reserved on its GPU, or the process's resident memory."""

from __future__ import annotations

from pathlib import Path

from hoigs.evaluation.protocol import NotComputed, Value

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
