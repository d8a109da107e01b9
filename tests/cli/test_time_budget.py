"""`--budget`: a time becomes a width and a number of steps."""

from __future__ import annotations

import pytest

from hoigs.core.errors import HoigsError, SpecError
from hoigs.training.budget import ENOUGH, MOST, StepTime, choose, plan_budget, seconds_of
from hoigs.training.options import TrainOptions
from hoigs.training.train import train

STEP = StepTime(0.02, 1e-6)  # 85 ms at 256x256
NATIVE = (1280, 720)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90), ("20m", 1200), ("2h", 7200), ("1h30m", 5400), ("0.5h", 1800), ("45", 45)],
)
def test_times_are_read(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "-5", "0s", "inf", "nan", "m", "1d", "5m2h"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(SpecError, match="90s, 20m"):
        seconds_of(text)


def test_a_line_through_two_times():
    assert StepTime.through((100, 1.0), (300, 2.0)).at(200) == pytest.approx(1.5)
    assert StepTime.through((100, 1.0), (300, 0.9)).at(500) == pytest.approx(1.0)  # noise
    assert StepTime.through((100, 1.0), (100, 1.2)).at(100) == pytest.approx(1.0)  # a tiny clip


def test_more_time_is_more_steps_then_more_pixels():
    plans = [choose(NATIVE, 24, limit, STEP) for limit in (60, 300, 1200, 7200, 10**6)]
    assert [plan.width for plan in plans] == sorted(plan.width for plan in plans)
    assert all(plan.steps >= ENOUGH for plan in plans[1:])
    assert (plans[-1].width, plans[-1].steps) == (1280, MOST)
    for plan in plans:
        assert plan.training_s + plan.scoring_s <= plan.limit_s
        assert plan.height == round(plan.width * 720 / 1280)


def test_too_short_a_time_names_one_that_is_enough():
    with pytest.raises(SpecError, match=r"100 steps .*128 .*18 s"):
        choose(NATIVE, 24, 10, STEP)
    assert choose(NATIVE, 24, 19, STEP).width == 128


def test_what_it_chooses_cannot_be_given_as_well():
    with pytest.raises(SpecError, match=r"train\.steps=5"):
        plan_budget("builtin:carry", TrainOptions(budget="5m", overrides=("train.steps=5",)))
    with pytest.raises(HoigsError, match=r"--budget.*resumed"):
        train(resume=True, out="nowhere", budget="5m")


def test_a_clip_is_measured(tiny_clip):
    """By a clock that a step takes a tenth of a second of."""
    spec, plan = plan_budget(tiny_clip, TrainOptions(budget="2h", overrides=SMALL), Ticks(0.5))
    native = 64
    assert (spec.train.width, spec.train.steps) == (plan.width, plan.steps) == (native, MOST)
    assert plan.step_s == pytest.approx(1.25 * 0.1)


SMALL = ("model.scene.points=200", "model.human.points=200", "model.object.points=100")


class Ticks:
    """A clock that goes on by a fixed time whenever it is read."""

    def __init__(self, step: float) -> None:
        self.time, self.step = 0.0, step

    def __call__(self) -> float:
        self.time += self.step
        return self.time
