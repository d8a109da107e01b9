"""Executors: where the processes of jobs run. `LocalExecutor`: on this machine, on all its GPUs."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from hoigs.core.errors import HoigsError
from hoigs.core.machine.cpus import available_cpus

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Needs:
    """What a process needs. gpu: whether it may compute on one. memory_gb: to set aside."""

    gpu: bool = True
    memory_gb: float = 0.0


class Process(Protocol):
    """A started process."""

    device: str

    def poll(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""

    def stop(self) -> None:
        """End it, and all that it started, and wait until they are gone."""


class Executor(Protocol):
    """Starts processes; what is done is read from disk, never from the executor."""

    slots: int

    def start(self, command: Sequence[str], log: Path, needs: Needs) -> Process | None:
        """Run `hoigs` with these arguments and append its output to `log`; None if all is busy."""


class LocalExecutor:
    """Processes on this machine, each with its share of cores, and one GPU where there are some.

    Args:
        slots: processes at a time. threads: of each; default cores / slots.
        memory_gb: of all together; default the memory of the machine.
        program: what runs a command; its arguments are this process's number and the command.
    """

    def __init__(
        self,
        slots: int = 1,
        threads: int | None = None,
        memory_gb: float | None = None,
        program: Sequence[str] = (sys.executable, "-m", "hoigs.studies.jobs.command"),
    ) -> None:
        self.slots = slots
        self._threads = threads or max(1, available_cpus() // slots)
        self._memory = memory_gb if memory_gb is not None else _memory_gb()
        self._program = tuple(program)
        self._gpus = visible_gpus()
        self._next_gpu = 0
        self._running: list[_LocalProcess] = []

    def start(self, command: Sequence[str], log: Path, needs: Needs) -> Process | None:
        """As `Executor.start`.

        Raises:
            HoigsError: it needs more memory than there is for all.
        """
        if needs.memory_gb > self._memory:
            raise HoigsError(
                f"needs {needs.memory_gb:g} GB of memory, and there are {self._memory:.1f}; lower "
                "the row's memory_gb"
            )
        self._running = [p for p in self._running if p.poll() is None]
        used = sum(p.needs.memory_gb for p in self._running)
        if len(self._running) >= self.slots or used + needs.memory_gb > self._memory:
            return None
        gpu = self._least_loaded() if needs.gpu and self._gpus else None
        environment = os.environ | dict.fromkeys(THREADS, str(self._threads))
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as file:
            process = subprocess.Popen(
                [*self._program, str(os.getpid()), *command],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,  # its group can be ended with all that it started
            )
        started = _LocalProcess(process, needs, "cpu" if gpu is None else f"GPU {gpu}")
        self._running.append(started)
        return started

    def _least_loaded(self) -> str:
        """The GPU with the fewest processes; among equals, the next in turn."""
        load = [sum(p.device == f"GPU {gpu}" for p in self._running) for gpu in self._gpus]
        count = len(self._gpus)
        turn = [(self._next_gpu + i) % count for i in range(count)]
        chosen = min(turn, key=lambda i: load[i])
        self._next_gpu = (chosen + 1) % count
        return self._gpus[chosen]


class _LocalProcess:
    def __init__(self, process: subprocess.Popen[bytes], needs: Needs, device: str) -> None:
        self._process, self.needs, self.device = process, needs, device
        self._ended = False

    def poll(self) -> int | None:
        code = self._process.poll()
        if code is not None and not self._ended:
            self._ended = True
            self._end_group(signal.SIGKILL)  # what a killed process leaves behind
        return code

    def stop(self) -> None:
        if self.poll() is not None:
            return
        self._end_group(signal.SIGTERM)
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._end_group(signal.SIGKILL)
            self._process.wait()
        self.poll()

    def _end_group(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, number)


def visible_gpus() -> list[str]:
    """GPUs of CUDA_VISIBLE_DEVICES, else all that the driver lists; torch is not imported."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [gpu.strip() for gpu in given.split(",") if gpu.strip() not in ("", "-1")]
    if shutil.which("nvidia-smi") is None:
        return []
    listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=False)
    return [str(i) for i in range(sum(x.startswith("GPU ") for x in listed.stdout.splitlines()))]


def _memory_gb() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
