"""Executor: starts the processes of jobs. It holds no state: what is done is what lies on disk."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from hoigs.core.errors import HoigsError, did_you_mean

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
    made: Executor = kind(slots=slots, threads=threads, address=address)
    return made


def stop_all(processes: Iterable[Process | None]) -> None:
    """Stop processes, all at a time, as each may take seconds to end."""
    running = [process for process in processes if process is not None]
    with ThreadPoolExecutor(max(1, len(running))) as pool:
        list(pool.map(lambda process: process.stop(), running))


def why_failed(log: Path, code: int) -> str:
    """The error at the end of a job's log: what follows "error: ", else the last line."""
    if code < 0:
        return f"ended by signal {-code}"
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    marked = [i for i, line in enumerate(lines) if line.startswith("error: ")]
    if marked:
        return " ".join(lines[marked[-1] :]).removeprefix("error: ")
    return lines[-1].strip() if lines else f"exit code {code}, and an empty log"
