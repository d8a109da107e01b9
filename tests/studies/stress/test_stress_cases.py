"""The 56 cases are complete and valid, and every check of hoigs' own code passes."""

from __future__ import annotations

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.maths.rotations import normalize_quats
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.studies.stress.case import COUNT, Case, Criterion, Sweep, all_cases, choose_cases
from hoigs.studies.stress.checks import CHECKS, PER_SPEC, check, density, motion
from hoigs.studies.stress.run import BASE, clip_names
from hoigs.synthesis.choreography import Choreographer
from hoigs.synthesis.named import clip_config
from hoigs.synthesis.object_motions import MOTIONS

CASES = all_cases()


def test_none_of_the_56_is_missing():
    assert [case.id for case in CASES] == [f"F{i:02d}" for i in range(1, COUNT + 1)]
    for case in CASES:
        assert case.title and case.trigger and case.criterion
        assert not case.nature or case.advice, f"{case.id}: what to do about a method's nature?"


def test_every_check_belongs_to_a_case_and_every_case_to_a_check():
    named = {case.check for case in CASES} | {case.per_spec for case in CASES}
    assert named - {None} == set(CHECKS) | set(PER_SPEC)


@pytest.mark.parametrize("name", CHECKS)
def test_checks_of_our_own_code_pass(name):
    result = check(name)()
    assert result.passed, result.measured
    assert result.measured


def test_a_slerp_that_ignores_signs_is_found(monkeypatch):
    def plain(a, b, r):
        return normalize_quats((1 - r) * a + r * b)

    monkeypatch.setattr(motion, "slerp", plain)
    assert not motion.slerp_signs().passed


def test_a_late_reset_is_found(monkeypatch):
    monkeypatch.setattr("hoigs.plugins.density.adc.LATEST_RESET", 1.0)
    result = density.late_reset_refused()
    assert not result.passed and "1000" in result.measured


def test_a_cap_that_does_not_hold_is_found(monkeypatch):
    monkeypatch.setattr(density, "CAP", 301)
    build = density.component
    monkeypatch.setattr(density, "component", lambda key, **own: build(key, **own | {"cap": 400}))
    assert not density.explosion_capped().passed


def test_every_value_of_a_sweep_is_a_clip():
    for case in CASES:
        if case.sweep is not None:
            clips = [clip_config(name) for name in clip_names(case.sweep, BASE)]
            assert all(k.width == 96 and k.frames == 24 for k in clips), case.id
            different = len({k.digest() for k in clips})
            assert different == (len(clips) if case.sweep.sets else 1), case.id


def test_the_person_reaches_the_object_in_every_clip():
    body = AnnyBody()
    configs = {
        clip_config(name).digest(): clip_config(name)
        for case in CASES
        if case.sweep is not None
        for name in clip_names(case.sweep, BASE)
    }
    for own in configs.values():
        script = MOTIONS[own.object.motion](own).script()
        poses = Choreographer(body, own).perform(script)
        assert poses.body.isfinite().all(), own


def test_cases_are_chosen_by_id_and_family():
    assert [c.id for c in choose_cases("F40, f07,F01")] == ["F01", "F07", "F40"]
    assert [c.id for c in choose_cases("human")] == [f"F{i}" for i in range(25, 32)]
    assert choose_cases("F01,all") == CASES
    with pytest.raises(HoigsError, match="F01 to F56"):
        choose_cases("F57")
    with pytest.raises(HoigsError, match='did you mean "camera"'):
        choose_cases("camra")


def test_criteria_hold_or_not():
    assert Criterion(measure="psnr_full", loses=1.0).holds(20.0, 21.0)
    assert not Criterion(measure="psnr_full", loses=1.0).holds(19.9, 21.0)
    assert Criterion(measure="gaussians", ratio=1.5).holds(150, 100)
    assert not Criterion(measure="gaussians", ratio=1.5).holds(151, 100)
    assert Criterion(measure="iou_object", at_least=0.7).holds(0.7, 0.0)
    assert not Criterion(measure="drift_of_path", at_most=0.1).holds(0.11, 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"why_not": "no"}, "or why_not"),
        ({"check": None}, "or why_not"),
        ({"concerns": ("wings",)}, "concerns"),
    ],
)
def test_an_invalid_case_is_refused(change, message):
    data = {"id": "F01", "title": "a", "trigger": "b", "criterion": "c", "check": "motion:x"}
    with pytest.raises(ValueError, match=message):
        Case.model_validate(data | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"required": 1.0}, "none of"),
        ({"required": 2.5}, "none of"),
        ({"sets": ()}, "varies a setting"),
        ({"draws": "psnr_ful"}, 'did you mean "psnr_full"'),
        ({"criteria": [{"measure": "psnr_full"}]}, "give one of"),
        ({"criteria": [{"measure": "psnr_fll", "loses": 1}]}, 'did you mean "psnr_full"'),
    ],
)
def test_an_invalid_sweep_is_refused(change, message):
    data = {"clip": "carry", "sets": ["fps={}"], "values": [1, 2, 3], "unit": "frames a second",
            "criteria": [{"measure": "psnr_full", "loses": 1}]}  # fmt: skip
    assert Sweep.model_validate(data).required_value == 3
    with pytest.raises(ValueError, match=message):
        Sweep.model_validate(data | change)
