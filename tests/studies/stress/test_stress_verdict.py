"""What seeds stood becomes a verdict."""

from __future__ import annotations

import pytest

from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.stress.case import choose_cases
from hoigs.studies.stress.verdict import Level, Seed, breaking, level_of, verdict_of

(CASE,) = choose_cases("F01")  # 1, 2, 3, 4, 6 eights; required: 4; loses at most 1 dB
VALUES = CASE.sweep.values


def seed(number: int, *stands: bool) -> Seed:
    return Seed(number, tuple(Level(v, s) for v, s in zip(VALUES, stands, strict=False)))


def test_a_seed_that_broke_stands_nothing_harder():
    broken = seed(0, True, True, False)
    assert broken.broke_at == 3
    assert [broken.stands(v) for v in VALUES] == [True, True, False, False, False]
    unfinished = seed(0, True, True)
    assert unfinished.broke_at is None and unfinished.stands(4) is None
    again = seed(0, True, False, True, True, True)  # whole: harder values were run all the same
    assert [again.stands(v) for v in VALUES] == [True, False, False, False, False]


@pytest.mark.parametrize(
    ("stood", "limitation", "status", "rate", "breaks_at"),
    [
        ((5, 5, 5), False, "pass", 1.0, None),
        ((4, 4, 2), False, "pass", 2 / 3, 6),
        ((3, 4, 2), False, "fail", 1 / 3, 4),
        ((3, 4, 2), True, "limitation", 1 / 3, 4),
        ((0, 0, 5), False, "fail", 1 / 3, 1),
        ((4, 0), False, "fail", 0.5, 1),
    ],
)
def test_most_seeds_decide(stood, limitation, status, rate, breaks_at):
    seeds = [seed(i, *([True] * n + [False])[: len(VALUES)]) for i, n in enumerate(stood)]
    verdict = verdict_of(CASE, "hoigs", limitation, seeds)
    assert (verdict.status, verdict.breaks_at) == (status, breaks_at)
    assert verdict.rate == pytest.approx(rate)


def test_what_is_not_known_is_no_verdict():
    seeds = [seed(0, True, True, True, True, True), seed(1, True)]
    verdict = verdict_of(CASE, "hoigs", False, seeds)
    assert verdict.status == "not run" and breaking(CASE.sweep, seeds) is None
    assert verdict_of(CASE, "hoigs", False, []).status == "not run"


def test_numbers_are_held_against_the_first():
    first = {"psnr_object": 20.0}
    assert level_of(CASE.sweep, 2, {"psnr_object": 19.2}, first, "r").stands
    level = level_of(CASE.sweep, 2, {"psnr_object": 18.5}, first, "r")
    assert not level.stands and "18.5 of 20" in level.why
    low = level_of(CASE.sweep, 1, {"psnr_object": 12.0}, {"psnr_object": 12.0}, "r")
    assert not low.stands, "what was never learned cannot be said to stand"
    absent = level_of(CASE.sweep, 2, {"psnr_object": NotComputed("no object")}, first, "r")
    assert not absent.stands and "no object" in absent.why
    both = [Seed(i, (level,)) for i in (0, 1)]
    measured = verdict_of(CASE, "hoigs", False, both).measured
    assert measured.count("loses at most") == 1 and "(seed 1, 2)" in measured
