"""The cases are complete and valid, and their clips can be made."""

from __future__ import annotations

import pytest

from hoigs.core.errors import HoigsError
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.studies.stress.case import Criterion, all_cases, choose_cases
from hoigs.studies.stress.measures import MEASURES
from hoigs.studies.stress.run import BASE, clip_names
from hoigs.synthesis.choreography import Choreographer
from hoigs.synthesis.named import clip_config
from hoigs.synthesis.object_motions import MOTIONS

CASES = all_cases()


def test_every_case_is_complete():
    assert len({case.id for case in CASES}) == len(CASES) > 10
    for case in CASES:
        assert case.title and case.trigger and case.criterion
        assert not case.limitation or case.advice, (
            f"{case.id}: no advice on a limitation of the method"
        )


def test_every_sweep_varies_something_and_measures_it():
    for case in CASES:
        sweep = case.sweep
        assert sweep.sets or sweep.blocks, case.id
        assert sweep.required_value in sweep.values[1:], case.id
        assert {sweep.drawn, *(c.measure for c in sweep.criteria)} <= set(MEASURES), case.id
        for criterion in sweep.criteria:
            bounds = criterion.model_dump(exclude={"measure"}, exclude_none=True)
            assert len(bounds) == 1, case.id


def test_every_value_of_a_sweep_is_a_clip():
    for case in CASES:
        clips = [clip_config(name) for name in clip_names(case.sweep, BASE)]
        assert all(k.width == 96 and k.frames == 24 for k in clips), case.id
        different = len({k.digest() for k in clips})
        assert different == (len(clips) if case.sweep.sets else 1), case.id


def test_the_person_reaches_the_object_in_the_hardest_clips():
    body = AnnyBody()
    hardest = {clip_names(case.sweep, BASE)[-1] for case in CASES}
    configs = {own.digest(): own for own in map(clip_config, sorted(hardest))}
    for own in configs.values():
        script = MOTIONS[own.object.motion](own).script()
        poses = Choreographer(body, own).perform(script)
        assert poses.body.isfinite().all(), own


def test_cases_are_chosen_by_id_and_family():
    assert [c.id for c in choose_cases("F38, f06,F01")] == ["F01", "F06", "F38"]
    assert [c.id for c in choose_cases("human")] == ["F27", "F28"]
    assert choose_cases("F01,all") == CASES
    with pytest.raises(HoigsError, match=r"F57.*F01.*motion"):
        choose_cases("F57")
    with pytest.raises(HoigsError, match=r'camra.*"camera"'):
        choose_cases("camra")


def test_criteria_hold_or_not():
    assert Criterion(measure="psnr_full", loses=1.0).holds(20.0, 21.0)
    assert not Criterion(measure="psnr_full", loses=1.0).holds(19.9, 21.0)
    assert Criterion(measure="gaussians", ratio=1.5).holds(150, 100)
    assert not Criterion(measure="gaussians", ratio=1.5).holds(151, 100)
    assert Criterion(measure="iou_object", at_least=0.7).holds(0.7, 0.0)
    assert not Criterion(measure="drift_of_path", at_most=0.1).holds(0.11, 0.0)
