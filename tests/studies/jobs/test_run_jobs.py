"""run_jobs: drivers of one study at the same time, and jobs that another one has."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from hoigs.core.system.folder_lock import FolderLock
from hoigs.studies.execution import queue
from hoigs.studies.execution.local import LocalExecutor
from hoigs.studies.jobs.job import Job
from hoigs.studies.jobs.run_jobs import OUT_OF_TIME, run_jobs

# a worker that notes that it ran, in place of a training
NOTING = """
import json, os, sys, time
from pathlib import Path
job = json.loads(sys.argv[1])
with open(os.environ["NOTES"], "a") as file:
    file.write(job["run"] + "\\n")
time.sleep(0.1)
if "broken" in job["run"]:
    sys.exit("error: this one is broken")
folder = Path(job["run"])
folder.mkdir(parents=True)
(folder / "evaluation.json").write_text("{}")
(folder / "job.json").write_text(json.dumps({k: job[k] for k in ("spec_hash", "clip_digest")}))
"""


@dataclass(frozen=True)
class NotingJob(Job):
    worker: ClassVar[str] = "noting_worker"


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    (tmp_path / "noting_worker.py").write_text(NOTING)
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.setenv("NOTES", str(tmp_path / "notes"))
    monkeypatch.setattr(queue, "TAKEN_POLL_S", 0.2)
    names = ("a", "b", "broken", "c")
    return [NotingJob("clip", "clip", "d", "static", (), "h", str(tmp_path / "runs" / n))
            for n in names]  # fmt: skip


def ran(folder: Path) -> Counter[str]:
    return Counter(Path(line).name for line in (folder / "notes").read_text().splitlines())


def test_two_drivers_run_every_job_once(jobs, tmp_path):
    start = threading.Barrier(2)

    def drive(_: int) -> dict[str, str]:
        start.wait()
        return dict(run_jobs(jobs, LocalExecutor(2)))

    with ThreadPoolExecutor(2) as pool:
        failed = list(pool.map(drive, range(2)))
    assert failed[0] == failed[1] == {jobs[2].run: "this one is broken"}
    assert all(ran(tmp_path)[name] == 1 for name in "abc")
    assert not list((tmp_path / "runs").glob(".*"))


def test_a_job_that_another_driver_has_is_waited_for(jobs, tmp_path):
    """Also one whose training outlived its driver."""
    words: list[str] = []
    locks = [FolderLock(jobs[0].lease, "x").acquire(), FolderLock(jobs[1].folder, "y").acquire()]

    def report(job: Job, word: str) -> None:
        words.append(f"{job.folder.name}: {word}")
        if word == "done" and job is jobs[3]:
            for lock in locks:
                lock.release()

    assert run_jobs([jobs[0], jobs[1], jobs[3]], LocalExecutor(1), report=report) == {}
    taken = "taken by another driver"
    assert words[:2] == [f"a: {taken}", f"b: {taken}"] and words[-1].endswith("done")
    assert set(ran(tmp_path).values()) == {1} and len(ran(tmp_path)) == 3


def test_a_job_whose_lease_is_taken_is_stopped(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(queue, "LEASE_POLL_S", 0.05)
    (tmp_path / "noting_worker.py").write_text("import time\ntime.sleep(60)\n")
    words: list[str] = []

    def report(job: Job, word: str) -> None:
        words.append(word)
        if word == "started":
            lock = job.lease.with_name(f".{job.lease.name}.lock")
            lock.write_text('{"token": "its", "host": "elsewhere", "pid": 1}')

    began = time.monotonic()
    failed = run_jobs(jobs[:1], LocalExecutor(1), limit_s=3, report=report)
    assert words == ["started", "taken by another driver"] and time.monotonic() - began < 10
    assert list(failed.values()) == [OUT_OF_TIME]
