"""Threads follow what the machine gives."""

from __future__ import annotations

import os

import pytest

from hoigs.core.machine import cpus


@pytest.mark.parametrize(
    ("files", "count"),
    [
        ({}, 64),
        ({"cpu.max": "max 100000\n"}, 64),
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "10000 100000\n"}, 1),
        ({"cpu.max": "nonsense"}, 64),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 64),
        ({"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"}, 4),
    ],
)
def test_processors_of_a_container(tmp_path, monkeypatch, files, count):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(cpus, "CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    assert cpus.available_cpus() == count


@pytest.mark.parametrize(
    ("load", "set_to"),
    [
        ("0.00 0.00 0.00 1/200 5", {"GOMP_SPINCOUNT": cpus.SHORT_SPIN}),
        ("0.00 0.00 0.00 3/200 5", {"OMP_WAIT_POLICY": "PASSIVE"}),
        ("nonsense", {"OMP_WAIT_POLICY": "PASSIVE"}),
    ],
)
def test_threads_wait_as_the_machine_is_busy(hoigs, monkeypatch, tmp_path, load, set_to):
    names = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, "")  # what the command sets ends with the test
        monkeypatch.delenv(name)
    (tmp_path / "loadavg").write_text(load)
    monkeypatch.setattr(cpus, "LOAD", tmp_path / "loadavg")
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert hoigs("--version").code == 0
    threads = {"OMP_NUM_THREADS": str(cpus.available_cpus())}
    assert {name: os.environ[name] for name in names if name in os.environ} == set_to | threads


def test_the_users_own_settings_of_threads_stay(hoigs, monkeypatch):
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    hoigs("--version")
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"
    assert "GOMP_SPINCOUNT" not in os.environ
