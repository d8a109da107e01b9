"""Every one of the 56 has a line, and all that is ours to pass passes."""

from __future__ import annotations

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.rotation import normalize_quats
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.studies.stress.case import COUNT, Case, Criterion, Knob, all_cases, choose_cases
from hoigs.studies.stress.checks import CHECKS, PER_SPEC, check, density, motion
from hoigs.studies.stress.plan import BASE, clip_names
from hoigs.synthesis.named import clip_knobs
from hoigs.synthesis.objects import MOTIONS
from hoigs.synthesis.person import Choreographer

CASES = all_cases()


def test_none_of_the_56_is_missing():
    assert [case.id for case in CASES] == [f"F{i:02d}" for i in range(1, COUNT + 1)]
    for case in CASES:
        assert case.title and case.trigger and case.criterion
        assert not case.nature or case.advice, f"{case.id}: what to do about a method's nature?"


def test_every_check_belongs_to_a_case_and_every_case_to_a_check():
    asked = {case.check for case in CASES} | {case.per_spec for case in CASES}
    assert asked - {None} == set(CHECKS) | set(PER_SPEC)


@pytest.mark.parametrize("name", CHECKS)
def test_what_is_ours_to_pass_passes(name):
    finding = check(name)()
    assert finding.passed, finding.measured
    assert finding.measured


def test_a_slerp_that_ignores_signs_is_found(monkeypatch):
    def plain(a, b, r):
        return normalize_quats((1 - r) * a + r * b)

    monkeypatch.setattr(motion, "slerp", plain)
    assert not motion.slerp_signs().passed


def test_a_late_reset_is_found(monkeypatch):
    monkeypatch.setattr("hoigs.plugins.density.adc.LATEST_RESET", 1.0)
    finding = density.late_reset_refused()
    assert not finding.passed and "1000" in finding.measured


def test_a_cap_that_does_not_hold_is_found(monkeypatch):
    monkeypatch.setattr(density, "CAP", 301)
    controls = density.AdaptiveDensity
    monkeypatch.setattr(density, "AdaptiveDensity", lambda cap, **more: controls(cap=400, **more))
    assert not density.explosion_capped().passed


def test_every_value_of_a_knob_is_a_clip():
    for case in CASES:
        if case.knob is not None:
            knobs = [clip_knobs(name) for name in clip_names(case.knob, BASE)]
            assert all(k.width == 96 and k.frames == 24 for k in knobs), case.id
            turned = len({k.digest() for k in knobs})
            assert turned == (len(knobs) if case.knob.sets else 1), case.id


def test_the_person_reaches_what_every_clip_asks_for():
    body = AnnyBody()
    knobs = {
        clip_knobs(name).digest(): clip_knobs(name)
        for case in CASES
        if case.knob is not None
        for name in clip_names(case.knob, BASE)
    }
    for own in knobs.values():
        script = MOTIONS[own.object.motion](own).script()
        poses = Choreographer(body, own).perform(script, own)
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
    ("change", "told"),
    [
        ({"why_not": "no"}, "or why_not"),
        ({"check": None}, "or why_not"),
        ({"concerns": ("wings",)}, "concerns"),
    ],
)
def test_a_case_that_says_nothing_is_refused(change, told):
    data = {"id": "F01", "title": "a", "trigger": "b", "criterion": "c", "check": "motion:x"}
    with pytest.raises(ValueError, match=told):
        Case.model_validate(data | change)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"asked": 1.0}, "none of"),
        ({"asked": 2.5}, "none of"),
        ({"sets": ()}, "sets something"),
        ({"draws": "psnr_ful"}, 'did you mean "psnr_full"'),
        ({"criteria": [{"measure": "psnr_full"}]}, "give one of"),
        ({"criteria": [{"measure": "psnr_fll", "loses": 1}]}, 'did you mean "psnr_full"'),
    ],
)
def test_a_knob_that_cannot_be_is_refused(change, told):
    data = {"clip": "carry", "sets": ["fps={}"], "values": [1, 2, 3], "unit": "frames a second",
            "criteria": [{"measure": "psnr_full", "loses": 1}]}  # fmt: skip
    assert Knob.model_validate(data).must_stand == 3
    with pytest.raises(ValueError, match=told):
        Knob.model_validate(data | change)
