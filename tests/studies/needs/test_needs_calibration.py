"""A gain counts only beyond what the same freedom brings where it is useless."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
import torch

from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.runs.clip_source import read_clip
from hoigs.studies.needs import calibration
from hoigs.studies.needs.calibration import _drawn, as_if_true, calibrated
from hoigs.studies.needs.result import track_moves
from hoigs.studies.needs.search_space import Halving, Score, StepBudget, as_settings
from hoigs.studies.needs.trial import SELECTION, Trial, isolated, region_of, selection_view

STEPS = 8


def score(*psnr: float) -> Score:
    return Score(psnr, tuple(1.0 for _ in psnr), tuple(100 for _ in psnr), 10)


@dataclass
class Pretended:
    """A trial that scores what it is told to, on the clip and where a cheaper one is the truth."""

    real: Score
    useless: Score
    advanced: list[str] = field(default_factory=list)

    def advance(self, until: int) -> Score:
        assert until == STEPS
        self.advanced.append("clip")
        return self.real

    def on(self, view: Any) -> Pretended:
        del view
        return Pretended(self.useless, self.useless)


SIMPLE = score(20.0, 21.0, 22.0)
RICH = score(21.0, 22.1, 22.9)  # 1 dB ahead on the clip


@pytest.fixture(autouse=True)
def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "as_if_true", lambda simple, rich: simple)


def chosen(useless: Score, allowance: float = 1e3) -> tuple[calibration.Calibrated, StepBudget]:
    trials: Any = [Pretended(SIMPLE, SIMPLE), Pretended(RICH, useless)]
    halving = Halving(0, ({4: SIMPLE}, {4: RICH, STEPS: RICH}))
    budget = StepBudget(allowance)
    return calibrated(trials, [0.5, 1.0], halving, STEPS, budget, least=0.0), budget


def test_what_gains_as_much_where_it_is_useless_is_not_needed() -> None:
    found, budget = chosen(useless=score(20.9, 22.0, 23.0))
    assert found.chosen == 0 and found.useless[0].mean == pytest.approx(0.97, abs=0.01)
    # what is left of the simple one's trial, two trainings on its drawings, three scorings
    assert budget.spent == pytest.approx(0.5 * 4 + 1.5 * 8 + (0.5 + 1.5) * 0.4 * 3)


def test_what_gains_nothing_where_it_is_useless_is_needed() -> None:
    found, _ = chosen(useless=score(20.0, 20.9, 22.0))
    assert found.chosen == 1


def test_three_frames_need_a_larger_gain_than_six() -> None:
    """0.9 dB are left, 2.8 standard errors: of three frames, 5 % of useless gains are more."""
    assert chosen(useless=score(20.7, 21.1, 21.5))[0].chosen == 0
    twice = Score(SIMPLE.psnr * 2, SIMPLE.squares * 2, SIMPLE.pixels * 2, 10)
    rich = score(*RICH.psnr, *RICH.psnr)
    trials: Any = [
        Pretended(twice, twice), Pretended(rich, score(20.7, 21.1, 21.5, 20.7, 21.1, 21.5)),
    ]  # fmt: skip
    halving = Halving(0, ({4: twice}, {4: rich, STEPS: rich}))
    found = calibrated(trials, [0.5, 1.0], halving, STEPS, StepBudget(1e3), least=0.0)
    assert found.chosen == 1


def test_another_finalist_may_need_what_the_best_does_not() -> None:
    """The best gains as much where it is useless; the one between them gains nothing there."""
    between = score(20.8, 21.9, 22.7)
    trials: Any = [
        Pretended(SIMPLE, SIMPLE), Pretended(between, SIMPLE), Pretended(RICH, score(21, 22, 23)),
    ]  # fmt: skip
    halving = Halving(0, ({4: SIMPLE}, {4: between, STEPS: between}, {4: RICH, STEPS: RICH}))
    found = calibrated(trials, [0.5, 0.7, 1.0], halving, STEPS, StepBudget(1e3), least=0.0)
    assert found.chosen == 1


def test_without_an_allowance_a_gain_counts_as_it_is() -> None:
    found, budget = chosen(useless=score(20.9, 22.0, 23.0), allowance=1.0)
    assert found.chosen == 1 and not found.useless and budget.spent == 0


def test_a_still_model_needs_more_than_silence_against_a_track_that_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trials: Any = [Pretended(SIMPLE, SIMPLE), Pretended(RICH, score(20.9, 22.0, 23.0))]
    monkeypatch.setattr(calibration, "_stands_still", lambda trial: trial is trials[0])
    for moves in (False, True):
        halving = Halving(0, ({4: SIMPLE}, {4: RICH, STEPS: RICH}))
        found = calibrated(
            trials, [0.5, 1.0], halving, STEPS, StepBudget(1e3), least=0.0, moves=moves
        )
        assert found.chosen == int(moves)


@pytest.mark.parametrize("name, moves", [("still-box", False), ("glide", True)])
def test_a_track_moves_or_not(name: str, moves: bool) -> None:
    clip = read_clip(
        f"builtin:{name}?frames=6&width=32&fps=2&samples=1&edge_samples=1&test_frames=2"
    )
    assert track_moves(clip, ["object"]) == moves


def test_an_obvious_gain_costs_nothing() -> None:
    trials: Any = [Pretended(SIMPLE, SIMPLE), Pretended(score(30, 31, 32), SIMPLE)]
    halving = Halving(0, ({4: SIMPLE}, {4: score(30, 31, 32), STEPS: score(30, 31, 32)}))
    budget = StepBudget(1e3)
    assert calibrated(trials, [1, 1], halving, STEPS, budget, least=0.0).chosen == 1
    assert budget.spent == 0


def test_the_drawn_view_has_the_errors_of_the_richer_model_where_it_is_scored(monkeypatch) -> None:
    monkeypatch.undo()
    view = selection_view(read_clip(
        "builtin:still-box?frames=12&width=32&height=32&samples=1&edge_samples=1&object_points=80"
        "&scene_points=100&held_out_views=0"
    ))  # fmt: skip
    overrides = isolated("object", ["object"], {"object": ["object"], "human": ["human"]}, 4)
    spec = Spec.load("hoigs", overrides=as_settings(overrides))
    simple, rich = (Trial(spec, view, "own", ["object"], default_registry()) for _ in range(2))
    simple.advance(2)
    rich.advance(4)
    drawn, itself = as_if_true(simple, rich), as_if_true(rich, rich)
    changed = 0
    for position in (*view.split["train"], *view.split[SELECTION]):
        before, after = view[position], drawn[position]
        where = region_of(before, view, "own", ["object"])
        assert torch.equal(before.rgb[~where], after.rgb[~where])
        assert torch.equal(before.rgb, itself[position].rgb), "its drawing with its own errors"
        theirs, errors = (
            shown.rgb - _drawn(trial, before) for trial, shown in ((simple, after), (rich, before))
        )
        inside = where[..., None] & (after.rgb > 0) & (after.rgb < 1)
        assert torch.allclose(theirs[inside], errors[inside], atol=1 / 255)
        changed += not torch.equal(before.rgb, after.rgb)
    assert changed > 0
