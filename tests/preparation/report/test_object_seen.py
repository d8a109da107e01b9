"""What is said of the frames in which an object is proven to be seen."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_prepare_report import report

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.clip_writing import _objects_seen, errors_of
from hoigs.preparation.objects.make_object import MadeObject
from hoigs.preparation.objects.tracked import ObjectConfidence
from hoigs.preparation.report.object_seen import ObjectSeen, best_click, by_state

CAMERA = Camera(torch.tensor([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]]), torch.eye(4), 80, 60)
STATES = ["seen"] * 3 + ["lost"] * 2 + ["seen"] + ["lost"] * 3 + ["hidden by a person"]


def made(way: str, outline: np.ndarray, overlap: float) -> MadeObject:
    """A ball of 0.2 m, 2 m away, in four frames."""
    points = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1) * 0.2
    turns, places = torch.eye(3).expand(4, 3, 3), torch.tensor([0.0, 0, 2]).expand(4, 3)
    track = ObjectTrack(points, points * 0, turns, places, torch.ones(4, dtype=torch.bool))
    return MadeObject(track, 0.01, ObjectConfidence(way, outline, outline), np.full(4, overlap))


def test_the_best_click_is_in_the_middle_of_the_longest_loss() -> None:
    numbers = [2 * i for i in range(len(STATES))]
    click = best_click(STATES, [1.0] * len(STATES), numbers)
    assert click is not None and click[0] == 14


def test_without_a_loss_the_best_click_is_where_doubt_is_greatest_or_nowhere() -> None:
    assert best_click(["seen"] * 3, [0.9, 0.3, 0.4], [5, 6, 7])[0] == 6  # type: ignore[index]
    assert best_click(["seen", "out of the picture"], [0.9, 0.0], [0, 1]) is None


def test_an_object_that_is_seen_in_few_frames_is_bad_and_its_other_frames_are_named() -> None:
    seen = ObjectSeen(by_state(STATES), (14, "it is lost"), place_m=0.05, overlap=0.8)
    assert seen.share == 0.4 and "turn cannot be seen" in seen.place
    whole_report = replace(report(), frames=len(STATES), objects_seen={"club": seen})
    (one,) = [d for d in whole_report.diagnostics() if d.kind == "club seen"]
    assert one.severity == "bad" and one.frames == (3, 4, 6, 7, 8, 9)
    assert "--object club=X,Y@FRAME" in one.do
    rows = [row[:2] for row in whole_report.rows()]
    assert ("club: seen, verified", "40 % of the frames") in rows
    assert ("club: outline", "IoU 0.80") in rows
    whole = replace(seen, states=by_state(["seen"] * 10), click=None)
    (one,) = [
        d
        for d in replace(whole_report, objects_seen={"club": whole}).diagnostics()
        if "club" in d.kind
    ]
    assert one.severity == "good" and not one.do


@pytest.mark.parametrize(
    ("states", "severity"),
    [
        (["out of the picture"] * 6 + ["seen"] * 4, "fair"),
        (["out of the picture"] * 4 + ["lost"] * 3 + ["seen"] * 3, "bad"),
        (["out of the picture"] * 10, "bad"),
    ],
)
def test_what_is_out_of_the_picture_is_not_missed(states: list[str], severity: str) -> None:
    seen = {"club": ObjectSeen(by_state(states))}
    found = replace(report(), frames=10, objects_seen=seen, coverage={"club": [0.0] * 10})
    assert [d.severity for d in found.diagnostics() if "club" in d.kind] == [severity]


@pytest.mark.parametrize(
    ("boxes", "overlap", "states"),
    [
        ([(3, 0, 0, 9, 9)], 0.5, {"doubtful": [0, 1, 3], "lost": [2]}),
        ([(3, 0, 0, 9, 9)], 0.8, {"seen": [0, 1, 3], "lost": [2]}),
        ([], 0.5, {"seen": [0, 1, 3], "lost": [2]}),  # it was clicked
    ],
)
def test_what_nobody_clicked_and_nothing_explains_is_not_seen(
    boxes: list[tuple[int, ...]], overlap: float, states: dict[str, list[int]]
) -> None:
    """The legs of a snowboarder and snow beside them counted as verified in 86 % of the frames."""
    found = SimpleNamespace(
        boxes=boxes, states=["seen", "seen", "lost", "seen"], confidence=np.ones(4), further={}
    )
    draft: Any = SimpleNamespace(
        objects={"legs": made("outline", np.full(4, 0.01), overlap)}, cameras=[CAMERA] * 4,
        found_object=found, track=SimpleNamespace(positions=range(4)),
        video=SimpleNamespace(indices=[0, 1, 2, 3]),
    )  # fmt: skip
    options: Any = SimpleNamespace(object_name="legs")
    seen = _objects_seen(draft, options)["legs"]
    assert seen.states == states
    assert seen.unexplained == ("doubtful" in states)
    if seen.unexplained:
        assert "legs" in seen.doubt("legs") and "0.50" in seen.doubt("legs")


@pytest.mark.parametrize("way", ["texture and hands", "outline"])
def test_a_turn_that_the_outline_hides_is_within_the_error(way: str) -> None:
    """The outline is off by what a turn of 15 degrees out of the picture moves it."""
    outline = np.full(4, 0.2 * (1 - np.cos(np.radians(15))))
    place, turn = errors_of(made(way, outline, 1.0), [CAMERA] * 4)
    assert place is not None and place > 0.02
    assert turn is None if way == "outline" else turn == pytest.approx(15, abs=0.5)
