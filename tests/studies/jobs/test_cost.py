"""Energy counters that start again, what a killed training leaves, fingerprints."""

from __future__ import annotations

import json
from pathlib import Path

from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.jobs.cost import (
    INTERRUPTED,
    NO_MEMORY,
    OLD,
    EnergyMeter,
    Machine,
    cpu_model,
    peak_memory,
    rapl_meter,
    read_cost,
    spent,
)

MACHINE = Machine("Xeon", 2, None, "2.13", "1.19")


def _package(root: Path, name: str, joules: float, what: str = "package-0") -> Path:
    folder = root / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "name").write_text(f"{what}\n")
    (folder / "energy_uj").write_text(str(round(joules * 1e6)))
    (folder / "max_energy_range_uj").write_text(str(1000 * 10**6))
    return folder


def test_packages_are_added_and_a_counter_that_started_again_is_understood(tmp_path: Path) -> None:
    _package(tmp_path, "intel-rapl:0", 990.0)
    _package(tmp_path, "intel-rapl:1", 5.0, "package-1")
    _package(tmp_path, "intel-rapl:0:0", 7.0, "core")  # part of package 0, not counted again
    meter = rapl_meter(tmp_path)
    assert isinstance(meter, EnergyMeter)
    _package(tmp_path, "intel-rapl:0", 10.0)
    _package(tmp_path, "intel-rapl:1", 6.0, "package-1")
    _package(tmp_path, "intel-rapl:0:0", 70.0, "core")
    assert abs(float(spent(meter)) - 21.0) < 1e-6  # type: ignore[arg-type]


def test_what_does_not_tell_says_why(tmp_path: Path) -> None:
    assert str(tmp_path / "none") in str(rapl_meter(tmp_path / "none"))
    assert str(tmp_path) in str(rapl_meter(tmp_path))


def _study(folder: Path, *parts: dict[str, object]) -> None:
    more = {"machine": MACHINE.to_dict(), "runs_at_once": 1}
    data = {"job": {}, "parts": [more | part for part in parts], "train_s": 4.5}
    (folder / "study.json").write_text(json.dumps(data))


def test_an_interrupted_training_has_seconds_but_no_joules(tmp_path: Path) -> None:
    whole = {"from_step": 0, "to_step": 9, "joules": 80.0, "source": "RAPL"}
    _study(tmp_path, whole)
    assert read_cost(tmp_path).memory_mb == NotComputed(NO_MEMORY)
    assert read_cost(tmp_path).joules == 80.0 and read_cost(tmp_path).source == "RAPL"
    moved = MACHINE.to_dict() | {"cpu": "Ryzen"}
    _study(tmp_path, {"from_step": 0}, whole | {"from_step": 5, "machine": moved})
    cost = read_cost(tmp_path)
    assert cost.train_s == 4.5 and cost.joules == NotComputed(INTERRUPTED)
    assert [m.partition(",")[0] for m in cost.machines] == ["Xeon", "Ryzen"]
    _study(tmp_path, whole | {"runs_at_once": 3})
    shared = read_cost(tmp_path)
    assert isinstance(shared.joules, NotComputed) and "3" in shared.joules.reason
    assert not shared.source and shared.runs_at_once == 3
    (tmp_path / "study.json").unlink()
    assert read_cost(tmp_path).train_s == NotComputed(OLD)


def test_memory_is_the_highest_of_all_parts_or_says_why_not(tmp_path: Path) -> None:
    first = {"from_step": 0, "to_step": 5, "memory_mb": 900.0, "memory_source": "GPU"}
    last = {"from_step": 5, "to_step": 9, "memory_mb": 700.0, "memory_source": "GPU"}
    _study(tmp_path, first, last)
    assert read_cost(tmp_path).memory_mb == 900.0 and read_cost(tmp_path).memory_source == "GPU"
    _study(tmp_path, {"from_step": 0}, last)  # its first part was killed before it wrote its peak
    assert read_cost(tmp_path).memory_mb == NotComputed(INTERRUPTED)
    _study(tmp_path, last | {"memory_mb": {"not_computed": "no /proc"}})
    assert read_cost(tmp_path).memory_mb == NotComputed("no /proc")


def test_peak_memory_is_what_the_system_reports(tmp_path: Path) -> None:
    status = tmp_path / "status"
    assert str(status) in str(peak_memory("cpu", status)[0])
    status.write_text("Name:\tpython\nVmPeak:\t 9000000 kB\nVmHWM:\t  500000 kB\n")
    assert peak_memory("cpu", status)[0] == 512.0
    status.write_text("Name:\tpython\n")
    assert "VmHWM" in str(peak_memory("cpu", status)[0])


def test_a_fingerprint_names_what_decides_a_time(tmp_path: Path) -> None:
    assert MACHINE.words == "Xeon, 2 cores; torch 2.13, warp 1.19"
    assert Machine("Xeon", 1, "H200", "2", "1").words == "H200, with Xeon, 1 core; torch 2, warp 1"
    info = tmp_path / "cpuinfo"
    info.write_text("processor : 0\nmodel name\t: Intel(R)  Xeon(R)\n")
    assert cpu_model(info) == "Intel(R) Xeon(R)" and cpu_model(tmp_path / "none")
