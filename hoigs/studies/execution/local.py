"""LocalExecutor: processes on this machine, on all its GPUs."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.system.environments import PYTHON
from hoigs.core.system.threads import available_cpus

# Executor: starts the processes of jobs. It holds no state: what is done is what lies on disk.

EXECUTORS = {
    "local": "hoigs.studies.execution.local:LocalExecutor",
    "ray": "hoigs.studies.execution.ray_tasks:RayExecutor",
}

LOST_RETRIES = 3  # of a process whose machine was lost, as by pre-emption


@dataclass(frozen=True)
class Needs:
    """What a process needs.

    Attributes:
        gpus: share of a GPU, 0 to 1; None: an equal share of those that there are, at most one.
        memory_gb: to set aside.
        retries: how often an executor may start it again as it is, where its machine was lost.
    """

    gpus: float | None = None
    memory_gb: float = 0.0
    retries: int = 0


class Process(Protocol):
    """A started process.

    Attributes:
        device: where it computes, as text. lost: whether its machine was lost while it ran.
    """

    device: str
    lost: bool

    def poll(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""

    def stop(self) -> None:
        """End it, and all that it started, and wait until they are gone."""


class Executor(Protocol):
    """Starts processes. Its constructor takes slots, threads and address, by name.

    Attributes:
        slots: how many processes its user starts at a time.
    """

    slots: int

    def start(
        self, command: Sequence[str], log: Path, needs: Needs, lease: str = ""
    ) -> Process | None:
        """Run a Python module with arguments, by `hoigs.studies.execution.command`.

        Args:
            command: the module, then its arguments: "hoigs", "train", …
            log: its output is appended to this file.
            lease: `FolderLock.lease`; the process ends when that lock is another's, or its holder
                on the same machine is dead.

        Returns:
            None if all is busy; the caller comes again.
        """


def make_executor(
    name: str, slots: int = 1, threads: int | None = None, address: str | None = None
) -> Executor:
    """An executor by name, or by "MODULE:CLASS" for one of your own.

    Args:
        slots: processes at a time. threads: of each; default cores / slots.
        address: of a cluster that the executor joins, where it has one.

    Raises:
        HoigsError: there is no such executor, its package is missing, or it has no cluster.
    """
    place = name if ":" in name else EXECUTORS.get(name)
    if place is None:
        raise HoigsError(
            f"--executor {name}: there is no such executor{did_you_mean(name, EXECUTORS)}; there "
            f"are {', '.join(EXECUTORS)}, or MODULE:CLASS for one of your own"
        )
    module, _, cls = place.partition(":")
    try:
        kind: Any = getattr(importlib.import_module(module), cls)
    except (ImportError, AttributeError) as error:
        raise HoigsError(f"--executor {name}: cannot be imported ({error})") from error
    return kind(slots=slots, threads=threads, address=address)


def why_failed(log: Path, code: int) -> str:
    """The error at the end of a job's log: what follows "error: ", else the last line."""
    if code < 0:
        return f"ended by signal {-code}"
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    marked = [i for i, line in enumerate(lines) if line.startswith("error: ")]
    if marked:
        return " ".join(lines[marked[-1] :]).removeprefix("error: ")
    return lines[-1].strip() if lines else f"exit code {code}, and an empty log"


PROGRAM = (*PYTHON, "-m", "hoigs.studies.execution.command")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
ROUNDING = 1e-6  # of sums of shares of a GPU


class LocalExecutor:
    """Processes on this machine, each with its share of cores, and one GPU where there are some.

    Args:
        slots: processes at a time. threads: of each; default cores / slots.
        address: must be None; there is no cluster.
        memory_gb: of all together; default the memory of the machine.
        program: what runs a command; its arguments are those of `hoigs.studies.execution.command`.

    Raises:
        HoigsError: an address was given.
    """

    def __init__(
        self,
        slots: int = 1,
        threads: int | None = None,
        address: str | None = None,
        memory_gb: float | None = None,
        program: Sequence[str] = PROGRAM,
    ) -> None:
        if address is not None:
            raise HoigsError(f"--address {address}: is for --executor ray; local has no cluster")
        self.slots = slots
        self._threads = threads or max(1, available_cpus() // slots)
        installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
        self._memory = installed if memory_gb is None else memory_gb
        self._program = tuple(program)
        self._gpus = visible_gpus()
        self._next_gpu = 0
        self._running: list[_LocalProcess] = []

    def start(
        self, command: Sequence[str], log: Path, needs: Needs, lease: str = ""
    ) -> Process | None:
        """As `Executor.start`.

        Raises:
            HoigsError: it needs more memory than there is for all, or more than one GPU.
        """
        if needs.memory_gb > self._memory:
            raise HoigsError(
                f"needs {needs.memory_gb:g} GB of memory, and there are {self._memory:.1f}; lower "
                "the row's memory_gb"
            )
        share = gpu_share(needs, len(self._gpus), self.slots) if self._gpus else 0.0
        self._running = [p for p in self._running if p.poll() is None]
        used = sum(p.memory_gb for p in self._running)
        if len(self._running) >= self.slots or used + needs.memory_gb > self._memory:
            return None
        gpu = self._least_loaded(share) if share else None
        if share and gpu is None:
            return None
        environment = thread_settings(self._threads)
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        process = start_process([*self._program, str(os.getpid()), lease, *command], log,
                                environment)  # fmt: skip
        started = _LocalProcess(process, needs.memory_gb, gpu, share)
        self._running.append(started)
        return started

    def _least_loaded(self, share: float) -> str | None:
        """The GPU with the most room, if it has enough; among equals, the next in turn."""
        load = [sum(p.share for p in self._running if p.gpu == gpu) for gpu in self._gpus]
        count = len(self._gpus)
        turn = [(self._next_gpu + i) % count for i in range(count)]
        chosen = min(turn, key=lambda i: round(load[i], 6))
        if load[chosen] + share > 1 + ROUNDING:
            return None
        self._next_gpu = (chosen + 1) % count
        return self._gpus[chosen]


class _LocalProcess:
    lost = False  # the machine is that of the driver

    def __init__(
        self, process: subprocess.Popen[bytes], memory_gb: float, gpu: str | None, share: float
    ) -> None:
        self._process, self.memory_gb, self.gpu, self.share = process, memory_gb, gpu, share
        self.device = "cpu" if gpu is None else f"GPU {gpu}"
        self._ended = False

    def poll(self) -> int | None:
        code = self._process.poll()
        if code is not None and not self._ended:
            self._ended = True
            end_group(self._process, signal.SIGKILL)  # what a killed process leaves behind
        return code

    def stop(self) -> None:
        if self.poll() is None:
            stop_process(self._process)
            self.poll()


def start_process(
    command: Sequence[str], log: Path, settings: dict[str, str], folder: str | None = None
) -> subprocess.Popen[bytes]:
    """A process with a group of its own, so that it can be ended with all that it started.

    Args:
        log: gets its output. settings: more environment. folder: where it starts.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
            env=os.environ | settings, cwd=folder, start_new_session=True,
        )  # fmt: skip


def stop_process(process: subprocess.Popen[bytes]) -> None:
    """End a process of `start_process` and its group: by SIGTERM, after 10 s by SIGKILL."""
    end_group(process, signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=10)
    end_group(process, signal.SIGKILL)
    process.wait()


def end_group(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def thread_settings(threads: int) -> dict[str, str]:
    """Environment of a process that computes with so many threads."""
    return dict.fromkeys(THREADS, str(threads))


def gpu_share(needs: Needs, gpus: int, slots: int) -> float:
    """Share of a GPU for a process, where there are `gpus` for `slots` processes.

    Raises:
        HoigsError: it is not between 0 and 1.
    """
    if needs.gpus is None:
        return 1.0 / max(1, math.ceil(slots / gpus))
    if not 0 <= needs.gpus <= 1:
        raise HoigsError(f"needs {needs.gpus:g} GPUs; expected a share of one, from 0 to 1")
    return needs.gpus


def visible_gpus() -> list[str]:
    """GPUs of CUDA_VISIBLE_DEVICES, else all that the driver lists; torch is not imported."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [gpu.strip() for gpu in given.split(",") if gpu.strip() not in ("", "-1")]
    if shutil.which("nvidia-smi") is None:
        return []
    listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=False)
    return [str(i) for i in range(sum(x.startswith("GPU ") for x in listed.stdout.splitlines()))]
