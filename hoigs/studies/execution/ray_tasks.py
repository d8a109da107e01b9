"""RayExecutor: processes on all machines of a Ray cluster, or by Ray on this machine.

Each process is a Ray task that starts it and waits for it. Ray holds no state: what a process has
done is what lies on the disk that all machines share.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hoigs
from hoigs.core.errors import HoigsError
from hoigs.studies.execution.local import (
    PROGRAM,
    Needs,
    Process,
    end_group,
    gpu_share,
    start_process,
    stop_process,
    thread_settings,
)

LOOPBACK = "127.0.0.1"
# read as Ray is imported; by default Ray takes another address of the machine in place of loopback,
# and then its servers listen on all of them
NO_CLUSTER = ("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
ANSWER_S = 10.0  # for the head of a cluster
POLL_S = 0.05
CANCEL_S = 15.0  # for the end of a process that was cancelled, which first gets SIGTERM


class RayExecutor:
    """Processes as Ray tasks; a Ray that this program has initialised already is used as it is.

    Args:
        slots: tasks that are submitted at a time. threads: of each; default CPUs / slots, at most
            those of the largest machine.
        address: of the cluster to join: "auto", or HOST:PORT of its head. By default Ray is started
            here, on the loopback interface, and ends with this process.
        program: arguments of the Python of a machine, before those of a command.

    Raises:
        HoigsError: Ray is not installed, there is no cluster at `address`, or Ray would listen on
            more than loopback.
    """

    def __init__(
        self,
        slots: int = 1,
        threads: int | None = None,
        address: str | None = None,
        program: Sequence[str] = PROGRAM[1:],
    ) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        if address is None:
            os.environ.setdefault(*NO_CLUSTER)
        try:
            import ray
        except ImportError as error:
            raise HoigsError(
                f"--executor ray: Ray is not installed ({error}); pip install 'hoigs[ray]'"
            ) from error
        self.slots, self._program, self._ray = slots, tuple(program), ray
        if not ray.is_initialized():
            _join(ray, address)
        cpus = [int(machine.get("CPU", 0)) for machine in self._machines()]
        self._threads = threads or max(1, min(sum(cpus) // slots, max(cpus)))
        self._gpus = int(sum(machine.get("GPU", 0) for machine in self._machines()))
        self._task = ray.remote(run_process)

    def start(
        self, command: Sequence[str], log: Path, needs: Needs, lease: str = ""
    ) -> Process | None:
        """As `Executor.start`; Ray queues what has no room yet.

        Raises:
            HoigsError: no machine has room for it even while it is idle.
        """
        given = needs.gpus is not None
        share = gpu_share(needs, self._gpus, self.slots) if self._gpus or given else 0.0
        wanted = {"CPU": self._threads, "GPU": share, "memory": int(1e9 * needs.memory_gb)}
        if not any(all(m.get(k, 0) >= v for k, v in wanted.items()) for m in self._machines()):
            raise HoigsError(
                f"no machine of the Ray cluster has {self._threads} CPUs, {share:g} GPUs and "
                f"{needs.memory_gb:g} GB of memory; lower --threads, or gpus or memory_gb of a row"
            )
        settings = {k: v for k, v in os.environ.items() if k.startswith("HOIGS_")}
        task = self._task.options(
            num_cpus=wanted["CPU"],
            num_gpus=share,
            memory=wanted["memory"],
            max_retries=needs.retries,
        )
        settings |= thread_settings(self._threads)
        words, here = [lease, *command], str(Path.cwd())
        reference = task.remote(self._program, words, str(log.absolute()), settings, here)
        return _RayProcess(self._ray, reference, log)

    def _machines(self) -> list[dict[str, float]]:
        """What the machines that are alive have, by Ray's names."""
        return [node["Resources"] for node in self._ray.nodes() if node["Alive"]]


def _join(ray: Any, address: str | None) -> None:
    """Join the cluster, or start Ray on this machine.

    Raises:
        HoigsError: there is no cluster, or Ray would listen on more than loopback.
    """
    if address is None:
        with _elsewhere():
            ray.init(
                address="local", include_dashboard=False, log_to_driver=False,
                logging_level="WARNING", _node_ip_address=LOOPBACK,
            )  # fmt: skip
        if (found := ray.util.get_node_ip_address()) != LOOPBACK:
            ray.shutdown()
            raise HoigsError(
                f"Ray listens on {found}, not on {LOOPBACK} alone, since it was imported before "
                f"{'='.join(NO_CLUSTER)} was set: set it, or start Ray yourself"
            )
        return
    try:
        if address != "auto":  # Ray itself waits many minutes for a head that is not there
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), ANSWER_S).close()
        with _elsewhere():
            ray.init(address=address, log_to_driver=False, logging_level="WARNING")
    except (OSError, ValueError, RuntimeError) as error:
        raise HoigsError(
            f"--address {address}: no Ray cluster answers there ({error}); on one of its machines "
            "`--address auto` finds it, and `ray start --head` starts one"
        ) from error


@contextmanager
def _elsewhere() -> Iterator[None]:
    """In the folder that holds the package hoigs: the workers of Ray import from the folder where
    it was initialised first of all, and in that of a data set may lie a numpy.py."""
    before = Path.cwd()
    os.chdir(Path(hoigs.__file__).parents[1])
    try:
        yield
    finally:
        os.chdir(before)


def run_process(
    program: Sequence[str], words: Sequence[str], log: str, settings: dict[str, str], folder: str
) -> tuple[int, str]:
    """In a Ray worker: the exit code of a process, and where it ran.

    Args:
        program: arguments of Python. words: those after the number of the parent.
        folder: where it starts, if that exists here.
    """
    command = [sys.executable, "-P", *program, str(os.getpid()), *words]
    here = folder if Path(folder).is_dir() else None
    process = start_process(command, Path(log), settings, here)
    try:
        while process.poll() is None:  # an interrupt, by which Ray cancels, comes between sleeps
            time.sleep(POLL_S)
    except BaseException:
        stop_process(process)
        raise
    end_group(process, signal.SIGKILL)
    gpus = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return process.returncode, f"{f'GPU {gpus}' if gpus else 'cpu'} of {socket.gethostname()}"


class _RayProcess:
    """A task; `device` is known once it has ended."""

    def __init__(self, ray: Any, reference: Any, log: Path) -> None:
        self._ray, self._reference, self._log = ray, reference, log
        self._code: int | None = None
        self.device, self.lost = "ray", False

    def poll(self) -> int | None:
        if self._code is None and self._ray.wait([self._reference], timeout=0)[0]:
            self._finish()
        return self._code

    def _finish(self) -> None:
        errors = self._ray.exceptions
        try:
            self._code, self.device = self._ray.get(self._reference)
        except errors.TaskCancelledError:
            self._code = -signal.SIGTERM
        except errors.RayError as error:  # of its worker, its machine, or the disk
            self.lost = not isinstance(error, errors.RayTaskError)
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("a", encoding="utf-8") as file:
                file.write(f"error: Ray lost the process: {' '.join(str(error).split())}\n")
            self._code = 1

    def stop(self) -> None:
        for force in (False, True):
            if self.poll() is not None:
                return
            self._ray.cancel(self._reference, force=force)
            self._ray.wait([self._reference], timeout=CANCEL_S)
        self.poll()
