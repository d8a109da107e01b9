"""Diagnostics of measures, the page that shows them, and DyCheck's multi-view factors."""

from __future__ import annotations

import dataclasses
import math
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from test_prepare_report import report

from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.camera_track import angular_factor, full_factor
from hoigs.preparation.report.diagnosis import diagnose
from hoigs.preparation.report.measures import BodyWithin
from hoigs.preparation.report.page import plot, report_page


def states(**changes: object) -> dict[str, tuple[str, str]]:
    changed = dataclasses.replace(report(), **changes)  # type: ignore[arg-type]
    return {d.kind: (d.severity, d.do) for d in diagnose(changed)}


def test_every_measure_is_judged_and_advised() -> None:
    bad = states(
        camera="moving", registered=0.6, reprojection_px=3.0, parallax_degrees=2.0,
        sharpness=[1.0] * 30 + [0.2] * 10, body_residual_px=9.0, object_scale_spread=0.3,
        depth_residual=0.2, omega=1.0, coverage={"human": [0.0] * 20 + [0.1] * 20},
        landmarks={"human": {"found": 30, "lost": {"dark": [*range(10)]}, "repaired": {}}},
    )  # fmt: skip
    assert {state for state, _ in bad.values()} == {"bad"} and len(bad) == 10
    assert all(advice for _, advice in bad.values())
    good = states(
        camera="moving", registered=1.0, reprojection_px=0.3, parallax_degrees=25.0,
        sharpness=[1.0] * 40, body_residual_px=0.5, object_scale_spread=0.02, depth_residual=0.02,
        omega=60.0, coverage={"human": [0.1] * 40},
        landmarks={"human": {"found": 39, "lost": {"dark": [3]}, "repaired": {"again": [4]}}},
    )  # fmt: skip
    assert set(good) == set(bad)
    assert set(good.values()) == {("good", "")}


def test_a_body_that_few_frames_show_is_not_good() -> None:
    few = {"human": {"found": 4, "lost": {"dark": [*range(4, 40)]}, "repaired": {}}}
    judged = states(body_residual_px=0.5, landmarks=few)
    assert judged["body on its landmarks"][0] == judged["landmarks of human"][0] == "bad"


def test_a_body_is_said_to_be_as_far_off_as_it_may_be() -> None:
    within = BodyWithin([0.04, 0.06, None, 0.2], [0.1] * 4, 2.0, "taken for the mean", ["legs"])
    judged = {
        d.kind: d for d in diagnose(dataclasses.replace(report(), bodies_within={"ann": within}))
    }
    joints, distance = judged["joints of ann"], judged["distance of ann"]
    assert joints.value == "± 60 mm" and joints.severity == "fair"
    assert distance.value == "± 5 %" and "legs" in distance.what
    wide = dataclasses.replace(report(), bodies_within={"ann": within}, focal_range=(0.7, 1.5))
    assert {d.kind: d.severity for d in diagnose(wide)}["distance of ann"] == "bad"


def test_limbs_that_are_guesses_are_named_but_for_parts_that_are_never_seen() -> None:
    guessed = {"left arm": [], "right arm": [1, 2], "left leg": [0, 1, 2, 3]}
    within = BodyWithin([0.04] * 4, [0.1] * 4, 2.0, "", ["legs"], guessed)
    judged = diagnose(dataclasses.replace(report(), bodies_within={"ann": within}))
    [limbs] = [d for d in judged if d.kind == "limbs of ann"]
    assert "right arm in frames 1-2" in limbs.what and "leg" not in limbs.what.split(":")[0]


def test_a_body_of_unknown_error_is_said_to_be_one() -> None:
    within = BodyWithin([None] * 4, [None] * 4, 2.0, "taken for the mean")
    judged = diagnose(dataclasses.replace(report(), bodies_within={"ann": within}))
    [joints] = [d for d in judged if d.kind == "joints of ann"]
    assert (joints.value, joints.severity) == ("not known", "bad")


def test_a_static_camera_is_not_asked_for_parallax() -> None:
    judged = states(displacement_px=0.13, focal_px=1024.0, focal_range=(0.75, 1.5))
    assert "parallax" not in judged and judged["camera"][0] == "fair"
    assert judged["focal length"][0] == "bad" and "--focal" in judged["focal length"][1]
    assert states(focal_px=900.0, focal_range=(0.97, 1.03))["focal length"] == ("good", "")


class Tags(HTMLParser):
    """Counts open tags, and every address that is not inside the file."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "polyline", "br"):
            self.open.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_and_asks_for_nothing(tmp_path: Path) -> None:
    shown = dataclasses.replace(
        report(), name="<mine>", sharpness=[1.0] * 40, body_residuals_px=[None, 2.0, 3.0, None, 1.0]
    )
    parser = Tags()
    (tmp_path / "overlay.mp4").write_bytes(b"video")
    page = report_page(shown, diagnose(shown), shown.rows(), folder=tmp_path)
    parser.feed(page.replace("/>", ">"))
    assert parser.open == [] and parser.links == ["data:video/mp4;base64,dmlkZW8="]
    assert "&lt;mine&gt;" in page and "<mine>" not in page and "$" not in page
    assert "beware of the dog" in page and "Masks, % of the image" in page
    assert "<video" not in report_page(shown, [], [], folder=tmp_path / "none")
    shown.save(tmp_path)
    assert "What to do" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")


def test_plots_leave_gaps() -> None:
    drawn = plot("x", {"": [1.0, 2.0, None, 2.0, None, None]})
    assert drawn.count("<polyline") == 2
    assert "0.0,45.0 60.0,0.0" in drawn


def orbiting(step: float, count: int = 5) -> list[Camera]:
    """Cameras 3 m from the origin, `step` degrees apart."""
    cameras = []
    for i in range(count):
        a = math.radians(step * i)
        eye = torch.tensor([3 * math.sin(a), 0.0, -3 * math.cos(a)])
        cameras.append(Camera.look_at(eye, torch.zeros(3), width=64, height=48, fov_y=0.8))
    return cameras


def test_effective_multi_view_factors() -> None:
    cameras, middle = orbiting(0.01), torch.zeros(5, 3)
    assert angular_factor(cameras, middle, 30.0) == pytest.approx(0.3, rel=2e-2)
    cameras = orbiting(4)
    assert angular_factor(cameras, middle, 25.0) == pytest.approx(100, rel=1e-4)
    chord = 2 * 3 * math.sin(math.radians(2))
    points = torch.zeros(5, 2, 3)
    points[:, :, 0] = 0.1 * torch.arange(5.0)[:, None]
    assert full_factor(cameras, points) == pytest.approx(chord / 0.1, rel=1e-4)
    assert full_factor(cameras, torch.zeros(5, 2, 3)) is None
    still = [cameras[0]] * 5
    assert angular_factor(still, middle, 25.0) == pytest.approx(0, abs=1e-6)
    assert full_factor(still, points) == pytest.approx(0, abs=1e-6)
