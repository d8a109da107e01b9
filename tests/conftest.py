"""Shared by all tests: run-time shape checks, threads, the optional shared data, `hoigs …`."""

from __future__ import annotations

import os
import random
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jaxtyping
import pytest
import torch
from browser import chromium, window
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook
from shapecheck import only_arrays

# a timing never gates a test: hypothesis has a deadline, and a check of slow machines
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

__all__ = ["chromium", "window"]  # fixtures: one browser a worker, whoever needs it

# Annotations are promises: every call in these modules is checked against its shapes and types.
# hoigs.rasterizers.warp is left out, because Warp reads the source of its kernels; the modules
# that pydantic and pluggy read are free of tensors.
CHECKED = (
    "hoigs.core",
    "hoigs.plugins",
    "hoigs.rasterizers.compositing",
    "hoigs.rasterizers.gsplat",
    "hoigs.rasterizers.oracle",
    "hoigs.rasterizers.torch_tiles",
    "hoigs.metrics.image_loss",
    "hoigs.metrics.inputs",
    "hoigs.metrics.lpips",
    "hoigs.metrics.psnr",
    "hoigs.metrics.regions",
    "hoigs.metrics.ssim",
    "hoigs.evaluation",
    "hoigs.training",
    "hoigs.runs",
    "hoigs.studies",
    "hoigs.testing",
    "hoigs.viewing",
)
install_import_hook(list(CHECKED), "shapecheck.check")
jaxtyping.jaxtyped = only_arrays(jaxtyping.jaxtyped)


def pytest_configure(config: pytest.Config) -> None:
    # two threads, or one in each of many workers: threads that wait for each other's core spin
    torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)


@pytest.fixture(autouse=True)
def ctrl_c_is_heard() -> Iterator[None]:
    """Ctrl-C as in a terminal for every test, and all that it starts: where the parent ignores
    SIGINT, as of `nohup`, of a job in the background and of some CI, so would they."""
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run the tests in random order")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    seed = config.getoption("--shuffle")
    if seed is not None:
        random.Random(seed).shuffle(items)
        return
    # files with slow tests first, so that the workers of a parallel run end at about the same time
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded clips and weights beside the repository; the test skips without it."""
    beside = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("HOIGS_SHARED", beside)) / "data"
    if not folder.is_dir():
        pytest.skip(f"no {folder}: set HOIGS_SHARED to the folder that holds data/")
    return folder


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """For modules that say so: what is this small is computed faster by one thread, far faster on
    a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


@pytest.fixture(params=DEVICES if torch.cuda.is_available() else DEVICES[:1])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device of this machine: the CPU, and CUDA where there is one."""
    return torch.device(request.param)


@dataclass(frozen=True)
class Outcome:
    """Exit code, stdout and stderr of one `hoigs …`."""

    code: int
    out: str
    err: str


@pytest.fixture
def as_users_run_it() -> Iterator[None]:
    """Without the test suite's checks of shapes, which would refuse what the code is to refuse."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def few_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    """The render time of 5 renders, not 110, and an orbit of 4, not 36: most of a tiny run's cost.

    tests/evaluation has the orbit at full length, and render times as they are configured.
    """
    from hoigs.evaluation import evaluate_run as workflow
    from hoigs.evaluation.report import media

    quick = partial(workflow.score, timing_frames=4, timing_warmup=1)
    monkeypatch.setattr(workflow, "score", quick)
    monkeypatch.setattr(media, "ORBIT_FRAMES", 4)


@pytest.fixture
def hoigs(monkeypatch, capsys, few_renders) -> Callable[..., Outcome]:
    """Run `hoigs ARGS…` in this process."""
    from hoigs.cli.main import main

    def run(*args: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["hoigs", *map(str, args)])
        capsys.readouterr()
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run
