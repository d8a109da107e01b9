"""Points, fronts and dominances against cases worked out by hand; nothing is trained."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_up_cells import NO_JOULES, A, B, cell, study

from hoigs.core.errors import HoigsError
from hoigs.evaluation.protocol import NotComputed
from hoigs.studies.compare.data import (
    AXES,
    UNEVEN,
    all_clips,
    dominances,
    dominates,
    dump_cells,
    front,
    load_chart,
    merged_about,
    points_of,
    usable_axes,
)
from hoigs.studies.jobs.results import ALL_CLIPS, Spread, definition, parse_variants

PSNR, TIME, JOULES = AXES["psnr_human_object"], AXES["train_s"], AXES["joules"]
LPIPS = AXES["lpips_full"]


def test_seeds_become_a_point_and_machines_stay_apart() -> None:
    cells = [cell(psnr=20.0), cell(psnr=22.0, seed=1), cell(psnr=27.0, seed=2),
             cell(psnr=30.0, machine=B), cell(seed=3, missing="it fell")]  # fmt: skip
    here, there = points_of(cells)
    assert here.seeds == (0, 1, 2) and there.seeds == (0,)
    assert here.values["psnr_human_object"] == Spread(23.0, pytest.approx(13**0.5), (20, 22, 27))
    assert here.missing == {3: "it fell"}
    assert here.number(JOULES) is None and there.spread(PSNR) == 0.0


def test_a_number_that_one_seed_lacks_is_not_a_mean_of_the_others() -> None:
    (point,) = points_of([cell(joules=5.0), cell(seed=1, joules=NO_JOULES)])
    assert point.values["joules"] == NO_JOULES


def test_times_are_of_the_seeds_that_ran_beside_the_fewest_others() -> None:
    curve = ((1, 1.0, 10.0), (2, 2.0, 20.0))
    cells = [cell(spec, psnr + s, train_s * (1 + 3 * s), seed=s, at_once=1 + 7 * s, curve=curve)
             for spec, psnr, train_s in (("a", 30.0, 5.0), ("b", 20.0, 9.0))
             for s in (0, 1)]  # fmt: skip
    a, b = points_of(cells)
    assert (a.number(PSNR), a.number(TIME)) == (30.5, 5.0)
    assert (a.seeds_of(PSNR), a.seeds_of(TIME), a.seeds, a.timed_seeds) == (2, 1, (0, 1), (0,))
    assert a.timed_sentence.startswith("Times, joules and memory are of seed 0;")
    assert a.curve == curve and not points_of(cells[:1])[0].timed_sentence
    (found,) = dominances([a, b], (PSNR,))
    (timed,) = dominances([a, b], (TIME, PSNR))
    assert found.sure and not timed.sure


def test_the_mean_of_clips_has_costs_where_all_ran_beside_as_many_others() -> None:
    (even,) = all_clips([cell(clip="a", at_once=4), cell(clip="b", psnr=30.0, at_once=4)])
    (uneven,) = all_clips([cell(clip="a"), cell(clip="b", psnr=30.0, at_once=4)])
    assert even.values == {"psnr_human_object": 25.0, "train_s": 10.0} and even.at_once == 4
    assert uneven.values == even.values | {"train_s": NotComputed(UNEVEN)}


def test_curves_are_averaged_where_every_seed_has_a_step() -> None:
    cells = [cell(curve=((1, 1.0, 10.0), (2, 2.0, 20.0))), cell(seed=1, curve=((2, 4.0, 22.0),))]
    assert points_of(cells)[0].curve == ((2, 3.0, 21.0),)


def test_clips_are_averaged_seed_by_seed_and_only_where_all_are_there() -> None:
    cells = [cell(psnr=20.0), cell(psnr=30.0, clip="throw"), cell("4dgs", 25.0),
             cell("far", 1.0), cell("far", 3.0, clip="throw", machine=B)]  # fmt: skip
    (mean,) = all_clips(cells)
    assert (mean.spec, mean.clip, mean.values["psnr_human_object"]) == ("hoigs", ALL_CLIPS, 25.0)


def test_the_front_is_what_nothing_dominates() -> None:
    cells = [cell("a", 20.0, 10.0), cell("b", 25.0, 20.0), cell("c", 24.0, 30.0),
             cell("d", 20.0, 12.0), cell("e", 25.0, 20.0)]  # fmt: skip
    points = points_of(cells)
    a, b, c, d, e = points
    assert [p.spec for p in front(points, (TIME, PSNR))] == [
        "a",
        "b",
        "e",
    ]  # equals do not dominate
    assert dominates(b, c, (TIME, PSNR)) and not dominates(c, b, (TIME, PSNR))
    assert dominates(a, d, (TIME, PSNR)) and not dominates(b, e, (TIME, PSNR))
    assert not dominates(a, b, (TIME, PSNR)), "cheaper and worse"


def test_lower_is_better_where_it_is() -> None:
    good, bad = points_of([cell("good", lpips_full=0.1), cell("bad", lpips_full=0.2)])
    assert dominates(good, bad, (TIME, LPIPS)) and not dominates(bad, good, (TIME, LPIPS))


def test_what_has_no_number_neither_dominates_nor_is_dominated() -> None:
    known, unknown = points_of([cell("a", joules=1.0), cell("b", joules=NO_JOULES)])
    assert not dominates(known, unknown, (JOULES, PSNR))
    assert front([known, unknown], (JOULES, PSNR)) == [known]


def test_a_lead_within_the_seeds_spread_is_unsure() -> None:
    def pair(gap: float) -> bool:
        cells = [cell("a", 20 + gap + d, 10.0, seed=s) for s, d in enumerate((-0.5, 0.5))]
        cells += [cell("b", 20 + d, 10.0, seed=s) for s, d in enumerate((-0.5, 0.5))]
        (found,) = dominances(points_of(cells), (TIME, PSNR))
        assert (found.winner.spec, found.loser.spec) == ("a", "b")
        return found.sure

    assert not pair(0.9) and pair(1.1)  # the difference's deviation is exactly 1
    noisy = [cell("a", 20.1 + d, 5.0, seed=s) for s, d in enumerate((-0.5, 0.5))]
    noisy += [cell("b", 20 + d, 10.0, seed=s) for s, d in enumerate((-0.5, 0.5))]
    (cheaper,) = dominances(points_of(noisy), (TIME, PSNR))
    assert not cheaper.sure, "cheaper for sure, but perhaps worse"
    (single,) = dominances(points_of([cell("a", 30.0), cell("b", 20.0)]), (TIME, PSNR))
    assert not single.sure


def test_times_of_two_machines_are_refused() -> None:
    points = points_of([cell(parameters=1.0, joules=NO_JOULES),
                        cell(parameters=1.0, machine=B, joules=NO_JOULES)])  # fmt: skip
    axes = (TIME, AXES["parameters"], JOULES)
    kept, refused = usable_axes(points, axes, mix_machines=False)
    assert kept == [AXES["parameters"]] and "2 machines" in refused[TIME.title]
    assert refused[JOULES.title] == str(NO_JOULES)
    assert usable_axes(points, axes, mix_machines=True)[0] == [TIME, AXES["parameters"]]
    assert usable_axes(points[:1], axes, mix_machines=False)[0] == [TIME, AXES["parameters"]]


def test_json_comes_back_as_it_went(tmp_path: Path) -> None:
    cells = [*study(seeds=1, lpips=False), cell(seed=9, missing="it fell")]
    path = tmp_path / "chart.json"
    path.write_text(dump_cells(cells, {"date": "today"}))
    assert load_chart(path) == (cells, {"date": "today"})
    assert json.loads(path.read_text())["points"][0]["machine"] == A
    path.write_text("{}")
    with pytest.raises(HoigsError, match=path.name):
        load_chart(path)
    with pytest.raises(HoigsError, match=r"none\.json"):
        load_chart(tmp_path / "none.json")


def test_what_all_added_charts_share_is_said_once() -> None:
    one, other = Path("a.json"), Path("b.json")
    made = {one: {"date": "2026-11-27", "settings": "none"},
            other: {"date": "2026-11-28", "settings": "none", "versions": "1"}}  # fmt: skip
    assert merged_about(made) == {
        "date (a.json)": "2026-11-27",
        "date (b.json)": "2026-11-28",
        "settings": "none",
        "versions (b.json)": "1",
    }
    assert merged_about({one: made[one]}) == made[one]


def test_specs_are_parsed_with_labels_and_settings() -> None:
    text = ("hoigs,mine/own.yaml, hoigs+model.object.deformation.use=deformation:acme-bounce,"
            "short=4dgs@matched+entities=[human,object]+train.rates.means=1e+3,"
            "hoigs+a.cap=5")  # fmt: skip
    found = parse_variants(text)
    assert [v.label for v in found] == ["hoigs", "own", "hoigs + acme-bounce", "short",
                                        "hoigs + cap=5"]  # fmt: skip
    assert found[3].spec == "4dgs@matched"
    assert found[3].settings == ("entities=[human,object]", "train.rates.means=1e+3")
    assert definition(found[2]) == "hoigs+model.object.deformation.use=deformation:acme-bounce"
    for wrong, fact in (("", "--specs"), ("hoigs,hoigs", '"hoigs"'), ("=hoigs", '"=hoigs"')):
        with pytest.raises(HoigsError, match=fact):
            parse_variants(wrong)


def test_reasons_survive_the_mean_over_clips() -> None:
    lost = NotComputed("no weights")
    (mean,) = all_clips([cell(lpips_full=lost), cell(clip="throw", lpips_full=0.1)])
    assert mean.values["lpips_full"] == NotComputed("carry: no weights")
