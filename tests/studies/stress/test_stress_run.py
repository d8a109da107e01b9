"""A study run twice, end to end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.spec.schema import Spec
from hoigs.studies.execution.local import LocalExecutor
from hoigs.studies.jobs.job import Job
from hoigs.studies.jobs.results import parse_variants
from hoigs.studies.stress.capabilities import capabilities, compose_small, small_settings
from hoigs.studies.stress.case import Case, choose_cases
from hoigs.studies.stress.run import StressStudy, block_settings, plan_chains, run_stress

BASE = (
    "width=32&frames=8&fps=4&samples=1&edge_samples=1&held_out_views=1&test_frames=2"
    "&scene_points=300&object_points=100"
)


pytestmark = pytest.mark.usefixtures("own_caches")


def short(case: Case) -> Case:
    """With the ends of its sweep alone."""
    ends = {"values": (case.sweep.values[0], case.sweep.values[-1]), "required": None}
    return case.model_copy(update={"sweep": case.sweep.model_copy(update=ends)})


def study(out: Path, cases: str, specs: str = "static", **more: object) -> StressStudy:
    chosen, rows = [short(case) for case in choose_cases(cases)], parse_variants(specs)
    small = {"seeds": 1, "steps": 4, "points": 100, "base": BASE}
    return StressStudy(chosen, rows, out, **small, **more)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_study_is_run_once_and_goes_on(tmp_path: Path) -> None:
    words: list[str] = []
    wanted = study(tmp_path, "F03,F49")

    def report(job: Job, word: str) -> None:
        words.append(word)

    stopped = run_stress(wanted, limit_s=0.0, report=report)
    by_case = {v.case: v for v in stopped}
    assert by_case["F49"].status == "not run" and not any(t == "done" for t in words)
    assert by_case["F03"].status == "not applicable"
    assert "positions at keyframes" in by_case["F03"].measured

    words.clear()
    (verdict,) = run_stress(
        study(tmp_path, "F49"), executor=LocalExecutor(2, threads=1), report=report
    )
    assert verdict.status in ("pass", "limitation") and len(verdict.seeds) == 1
    assert verdict.machines and "2 frames of split 'test'" in verdict.protocol[0]
    values = [level.value for level in verdict.seeds[0].levels]
    assert values == [0, 0.9][: len(values)]
    level = verdict.seeds[0].levels[0]
    scores = json.loads((tmp_path / level.run / "evaluation.json").read_text())
    (full,) = [s for s in scores["scores"] if (s["view"], s["region"], s["metric"]) ==
               ("test frames", "full", "psnr")]  # fmt: skip
    assert level.values["psnr_full"] == full["value"]
    assert words.count("done") == sum(len(s.levels) for s in verdict.seeds)

    words.clear()
    (again,) = run_stress(
        study(tmp_path, "F49"), executor=LocalExecutor(2, threads=1), report=report
    )
    assert again == verdict and set(words) == {"done before"}


def test_a_spec_is_made_small_by_what_it_has() -> None:
    whole = Spec.load("ex4dgs")
    settings = dict(s.split("=") for s in small_settings(whole, 1000, 400))
    assert settings["model.scene.points"] == "1000"
    assert settings["model.scene.density.cap"] == "2000"
    assert settings["model.scene.deformation.promote_from"] == "5"  # 500 of 40 000
    parts = dict(s.split("=") for s in small_settings(Spec.load("hoigs"), 1000, 400))
    points = [int(parts[f"model.{n}.points"]) for n in ("scene", "human", "object")]
    assert points == [600, 300, 100]
    assert "model.human.density.cap" not in parts


def test_sweeps_of_a_spec_are_set_where_it_has_them() -> None:
    (case,) = choose_cases("F03")
    assert block_settings(Spec.load("hoigs"), case.sweep, 2) == [
        "model.object.deformation.keyframe_step=2"
    ]
    assert block_settings(Spec.load("ex4dgs"), case.sweep, 1) == [
        "model.scene.deformation.interval=1"
    ]


@pytest.mark.slow
def test_chains_share_what_they_have_in_common(tmp_path: Path) -> None:
    wanted = study(tmp_path, "F01,F49", "static,hoigs")
    has = {"static": frozenset({"scene"}), "hoigs": frozenset({"scene", "moves"})}
    chains = plan_chains(wanted, has)  # type: ignore[arg-type]
    assert {(c.case.id, c.spec.label) for c in chains} == {
        ("F01", "hoigs"), ("F49", "hoigs"), ("F49", "static")
    }  # fmt: skip
    runs = {c.case.id: c.jobs[0].run for c in chains if c.spec.label == "hoigs" and c.seed == 0}
    assert runs["F01"] == runs["F49"], "one clean clip, one training"
    with pytest.raises(HoigsError, match=r"statik.*static"):
        plan_chains(study(tmp_path, "F49", "statik"), {"statik": frozenset()})


@pytest.mark.parametrize(
    ("source", "has", "lacks"),
    [
        ("hoigs", {"body", "object", "masks", "moves", "time planes"}, {"whole picture"}),
        ("4dgs", {"scene", "whole picture", "time planes", "networks"}, {"body", "masks"}),
        ("ex4dgs", {"knots", "free knots", "keyed opacity"}, {"time planes"}),
    ],
)
@pytest.mark.slow
def test_capabilities_are_what_a_spec_composes(source: str, has: set[str], lacks: set[str]) -> None:
    found = capabilities(*compose_small(source)[1:])
    assert has <= found and not lacks & found
