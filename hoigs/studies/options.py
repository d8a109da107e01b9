"""Options of verbs that start many trainings: `hoigs study compare`, `stress`, `hoigs batch`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from hoigs.core.options import Flag, Options
from hoigs.core.system.threads import available_cpus

if TYPE_CHECKING:
    from hoigs.studies.execution.local import Executor


class ExecutionOptions(Options):
    """Where the processes of trainings run."""

    jobs: Annotated[int, Field(ge=1)] = 1
    """Trainings at a time."""
    threads: Annotated[int, Field(ge=1)] | None = None
    """Threads of each training; default: cores / jobs."""
    executor: str | Any = "local"
    """Where trainings run: local (this machine and its GPUs in turn), ray (all of a Ray cluster;
    pip install 'hoigs[ray]'), or MODULE:CLASS of your own; in Python also an Executor."""
    address: str | None = None
    """Ray cluster to join: auto, HOST:PORT. Default: Ray on this machine only."""

    def each(self) -> int:
        """Threads of each training."""
        return self.threads or max(1, available_cpus() // self.jobs)

    def place(self) -> Executor:
        """The executor that these options name.

        Raises:
            HoigsError: there is no such executor, its package is missing, or it has no cluster.
        """
        from hoigs.studies.execution.local import make_executor

        if not isinstance(self.executor, str):
            return self.executor
        return make_executor(self.executor, self.jobs, self.threads, self.address)


class StudyOptions(ExecutionOptions):
    """Of studies that train several specs with several seeds."""

    seeds: Annotated[int, Field(ge=1)] = 3
    """Number of seeds: 0, 1 …"""
    minutes: float | None = None
    """Stop after this time and write the results so far; the same command continues."""
    overrides: Annotated[tuple[str, ...], Flag("--set")] = ()
    """Set one key of every spec: train.steps=500."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda if available."""
    plugins: Annotated[tuple[Path, ...], Flag("--plugin")] = ()
    """Also load this Python file as a plugin; its code runs."""

    def where(self) -> str:
        """The device of the trainings; a GPU of other machines need not be in this one."""
        from hoigs.runs.choices import pick_device

        here = self.executor == "local" or self.device == "auto"
        return pick_device(self.device) if here else self.device

    def limit_s(self) -> float | None:
        """`minutes` in seconds."""
        return None if self.minutes is None else 60 * self.minutes


class CompareOptions(StudyOptions):
    """Which methods are compared, and at what cost."""

    specs: str | None = None
    """Specs with commas between, each [LABEL=]SPEC[+KEY=VALUE…]:
    hoigs,mine.yaml,hoigs+interaction.use=interaction:none; default: hoigs,static, or none with
    --table."""
    table: tuple[str, ...] = ()
    """Also the rows of a table of the paper, next to the numbers that it prints: comparison,
    ablation-object-motion, ablation-interaction, ablation-human-feature, object-prior,
    mask-depth-source, or all."""
    rasterizers: str = ""
    """Rasterizers: warp,torch …; default: each spec's own."""
    budgets: str = ""
    """Steps: 200,1000; default: each spec's own."""
    out: Path = Path("runs/compare")
    """Folder of runs and results."""
    add: tuple[Path, ...] = ()
    """Also draw the results of this chart.json; without CLIPS, only those."""
    mix_machines: bool = False
    """Draw times that were measured on different machines."""
    lpips_weights: Path | None = None
    """File of LPIPS weights; default: $HOIGS_LPIPS_WEIGHTS, or else AlexNet's, shipped."""


class StressOptions(StudyOptions):
    """Which failure cases are tried, and on what."""

    cases: str = "all"
    """Ids and families with commas between: F01,F10,motion,camera; or all."""
    specs: str = "hoigs,static"
    """Specs with commas between: hoigs,4dgs@matched,mine.yaml."""
    steps: Annotated[int, Field(ge=1)] = 300
    """Steps of every training."""
    points: Annotated[int, Field(ge=50)] = 4000
    """Initial Gaussians of every model."""
    width: Annotated[int, Field(ge=32)] = 96
    """Width of the clips, pixels."""
    whole: bool = False
    """Run harder values even after a seed has failed one."""
    out: Path = Path("runs/stress")
    """Folder of runs and results."""
    device: str = "cpu"
    """cpu, cuda, or auto: cuda if available."""


class WorkOptions(ExecutionOptions):
    """How the rows of a batch are worked on."""

    retries: Annotated[int, Field(ge=0)] = 1
    """Further attempts at stages of a row that fail."""


class BatchOptions(WorkOptions):
    """What is done with rows of a manifest that do not set it themselves, and with which rows."""

    spec: str | None = None
    """Spec of rows that name none; default: hoigs."""
    auto: bool = False
    """As for `hoigs train`, for rows that do not set it."""
    overrides: Annotated[tuple[str, ...], Flag("--set")] = ()
    """Keys of the spec for rows without `set`."""
    export: tuple[str, ...] = ()
    """Format for rows without `export`; default: ply."""
    device: str | None = None
    """cpu, cuda or auto, for rows that name none."""
    limit: Annotated[int, Field(ge=1)] | None = None
    """Only this many rows, the first."""
    only: str | None = None
    """failed: only rows whose last attempt failed."""
    dry_run: bool = False
    """Check the manifest and print what would run."""

    def defaults(self) -> dict[str, Any]:
        """Keys for rows that have none."""
        given = {"spec": self.spec, "auto": self.auto, "set": list(self.overrides),
                 "export": list(self.export), "device": self.device}  # fmt: skip
        return {key: value for key, value in given.items() if value}
