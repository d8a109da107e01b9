"""Frames held back and sealed, the choice of a candidate, successive halving, search spaces."""

from __future__ import annotations

import math

import pytest

from hoigs.core.errors import ClipError, HoigsError
from hoigs.studies.needs.search_space import (
    FEWEST,
    PATIENCE,
    SCORING,
    BudgetError,
    Score,
    StepBudget,
    choose,
    expanded,
    gain,
    load_search_spaces,
    merged,
    near_best,
    plan,
    ranked,
    rounds,
    successive_halving,
)
from hoigs.studies.needs.trial import selection_frames


def score(*psnr: float, parameters: int = 100, pixels: int = 900) -> Score:
    squares = tuple(pixels * 10 ** (-p / 10) for p in psnr)
    return Score(psnr, squares, (pixels,) * len(psnr), parameters)


# -- the criterion ---------------------------------------------------------------------------------


def test_gain_is_paired():
    """What all candidates share (a hard frame) is not in the error."""
    difference = gain(score(30, 20, 25), score(29, 19.2, 24.4))
    assert difference.mean == pytest.approx(0.8)
    assert difference.error == pytest.approx(0.2 / math.sqrt(3))


def test_gain_refuses_other_frames_and_single_ones():
    with pytest.raises(ValueError, match="3 and 2"):
        gain(score(1, 2, 3), score(1, 2))
    with pytest.raises(ValueError, match="two or more"):
        gain(score(1), score(2))


def test_cheapest_within_one_error_of_the_best():
    steady = [score(20, 21, 22), score(25, 26, 27), score(25.5, 26.5, 27.4)]
    assert choose(steady) == 2  # 0.47 dB better at an error of 0.03
    noisy = [score(20, 21, 22), score(25, 26, 27), score(27, 26.4, 26)]
    assert near_best(noisy) == [False, True, True]
    assert choose(noisy) == 1


def test_equal_candidates_give_the_cheapest():
    assert choose([score(20, 21), score(20, 21), score(20, 21)]) == 0


def test_least_gain_counts_for_nothing():
    table = [score(25, 26, 27), score(25.05, 26.06, 27.05)]
    assert choose(table) == 1
    assert choose(table, 0.1) == 0


def test_ranking_puts_the_cheap_before_its_equals_and_the_good_before_the_bad():
    table = [score(10, 11), score(25, 26), score(20, 21), score(25, 26.1)]
    assert ranked(table, 0.1) == [1, 3, 2, 0]


def test_the_best_is_not_crowded_out_by_those_that_few_frames_cannot_tell_from_it():
    """Three frames that disagree: cheap ones are within 1.5 standard errors, decibels below."""
    cheap, cheaper = score(10, 10.5, 19), score(10.2, 10, 19)
    table = [cheaper, cheap, score(10, 10.5, 19.5), score(16, 10.5, 19)]
    assert near_best(table, 0.1, errors=PATIENCE) == [True] * 4
    assert ranked(table, 0.1) == [0, 3, 1, 2]


# -- halving ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "expected"), [(2, (2,)), (3, (3, 2)), (5, (5, 3, 2)), (7, (7, 4, 2)), (1, (1,))]
)
def test_rounds(count, expected):
    assert rounds(count) == expected


def cost_of(shape, costs, frames):
    """What the rounds cost if the dearest stay."""
    total, before = 0.0, 0
    for alive, until in zip(shape.alive, shape.until, strict=True):
        total += sum(sorted(costs)[-alive:]) * (until - before + SCORING * frames)
        before = until
    return total


@pytest.mark.parametrize("budget", [150.0, 333.0, 1000.0])
def test_a_plan_uses_its_budget_and_no_more(budget):
    costs = [0.5, 0.5, 0.6, 1.0, 1.2]
    shape = plan(costs, budget, 3, most=10_000)
    assert shape.until == (shape.until[0], 2 * shape.until[0], 4 * shape.until[0])
    assert cost_of(shape, costs, 3) <= budget
    longer = type(shape)(shape.alive, tuple(u + u // shape.until[0] for u in shape.until))
    assert cost_of(longer, costs, 3) > budget


def test_a_plan_goes_no_further_than_a_full_training():
    assert plan([1.0] * 4, 1e6, 3, most=500).steps == 500


def test_a_budget_too_small_says_what_is_needed():
    with pytest.raises(BudgetError, match=r"4 .*\b20\b"):
        plan([1.0] * 4, 20, 3, most=500)


def test_the_least_plan_is_affordable():
    costs, frames = [1.0, 1.0], 3
    poorest = 2 * (FEWEST + SCORING * frames)
    assert plan(costs, poorest, frames, most=500).until == (FEWEST,)


class Toy:
    """Candidates whose score is known: plateau minus what training has still to gain."""

    def __init__(self, plateaus):
        self.plateaus, self.calls = plateaus, []

    def __call__(self, candidate, until):
        self.calls.append((candidate, until))
        level = self.plateaus[candidate] - 50 / until
        return score(level, level + 0.5, level - 0.3)


def test_halving_finds_the_cheapest_that_is_good_enough():
    toy, costs = Toy([15, 22, 30, 30.05, 30.1, 29.0, 30.0]), [1.0] * 7
    shape = plan(costs, 2000, 3, most=10_000)
    budget = StepBudget(2000)
    halving = successive_halving(shape, costs, 3, toy, budget, least=0.2)
    assert halving.chosen == 2
    trained = [sum(1 for k, _ in toy.calls if k == candidate) for candidate in range(7)]
    assert trained[2] == 3 and trained[0] == 1 and sorted(trained) == [1, 1, 1, 2, 2, 3, 3]
    assert budget.spent == pytest.approx(cost_of(shape, costs, 3))
    step, own, chosen = halving.last_common(0, 2)
    assert step == shape.until[0] and gain(own, chosen).mean == pytest.approx(-15)


def test_the_budget_is_checked_before_each_training():
    toy, costs = Toy([20, 21]), [1.0, 1.0]
    shape = plan(costs, 100, 3, most=1000)
    with pytest.raises(BudgetError, match="left"):
        successive_halving(shape, costs, 3, toy, StepBudget(60), least=0.0, what="object")
    assert len(toy.calls) == 1  # the second would have gone beyond


# -- frames held back ------------------------------------------------------------------------------


def test_a_twentieth_of_the_training_frames_is_held_back():
    train = [p for p in range(200) if p % 5]
    held = selection_frames(train)
    assert len(held) == 8 and set(held) <= set(train)
    assert train[0] not in held and train[-1] not in held


def test_three_at_least():
    assert selection_frames(list(range(12))) == [2, 6, 10]


def test_too_few_frames_are_refused():
    with pytest.raises(ClipError, match=r"\b7\b.*\b3\b"):
        selection_frames(list(range(7)))


# -- overrides -------------------------------------------------------------------------------------

BLOCKS = {"human": ["ann", "bob"], "object": [], "scene": ["scene"]}


def test_kinds_in_keys_become_blocks():
    overrides = {"model.{human}.features": None, "model.{object}.features": None, "a": 1}
    assert expanded(overrides, BLOCKS) == {
        "model.ann.features": None,
        "model.bob.features": None,
        "a": 1,
    }


def test_overrides_are_laid_key_by_key():
    below = {"a.b": {"use": "x", "n": 1}, "a.c": 2}
    assert merged(below, {"a.b.n": 3}) == {"a.b": {"use": "x", "n": 3}, "a.c": 2}
    assert merged(below, {"a": None}) == {"a": None}
    with pytest.raises(HoigsError, match=r"\ba\b.*None"):
        merged({"a": None}, {"a.b": 1})


def test_the_built_in_search_spaces_are_valid():
    search_spaces = load_search_spaces()
    names = [space.name for space in search_spaces]
    assert names[:5] == ["scene", "object", "human", "human pose", "interaction"]
    assert all(candidate.why for space in search_spaces for candidate in space.candidates)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "search_spaces: [{name: a, kind: object, candidates: [{name: x, why: y}]}]",
            "at least 2 items",
        ),
        (
            "search_spaces: [{name: a, kind: objekt, candidates: []}]",
            "'scene', 'human', 'object' or 'pair'",
        ),
        (
            "search_spaces: [{name: a, kind: object, unless: {b: [c]},"
            " candidates: [{name: x, why: y}, {name: z, why: y}]}]",
            "'b'",
        ),
        (
            "search_spaces: [{name: a, kind: object,"
            " candidates: [{name: x, why: y}, {name: x, why: y}]}]",
            "name",
        ),
        (
            "search_spaces: [{name: a, kind: object, smallest_only: true, untried: plane,"
            " candidates: [{name: planes, why: y}, {name: z, why: y}]}]",
            "no candidate 'plane'; did you mean .planes",
        ),
        (
            "search_spaces: [{name: a, kind: object, candidates: [{name: parts, why: y,"
            " moves_unlike: pieces}, {name: piece, why: y}]}]",
            "no candidate 'pieces' above it",
        ),
    ],
)
def test_search_spaces_of_a_file_are_checked(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(HoigsError, match=message):
        load_search_spaces(path)
