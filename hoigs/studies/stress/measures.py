"""Measures that criteria refer to: numbers of the evaluation, and those of `observe`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from hoigs.evaluation.protocol import NotComputed, Value, from_json
from hoigs.studies.jobs.results import Measure, measures_of

STRESS = "stress"  # in evaluation.json, beside the evaluation's own


@dataclass(frozen=True)
class Scored:
    """A measure of a training.

    Attributes:
        title: for reports. place: in `measures_of`; None is a number of `stress.observe`.
        better: the better direction.
    """

    title: str
    unit: str
    better: Literal["higher", "lower"]
    digits: int = 2
    place: Measure | None = None


def _psnr(region: str, view: str = "test frames") -> Scored:
    words = region.replace("_", " + ")
    where = "" if view == "test frames" else ", held-out cameras"
    return Scored(f"PSNR, {words}{where}", "dB", "higher", 2, (view, region, "psnr"))


MEASURES: Mapping[str, Scored] = {
    "psnr_full": _psnr("full"),
    "psnr_human": _psnr("human"),
    "psnr_object": _psnr("object"),
    "psnr_human_object": _psnr("human_object"),
    "held_out_psnr_full": _psnr("full", "held-out cameras"),
    "held_out_psnr_human_object": _psnr("human_object", "held-out cameras"),
    "held_out_psnr_object": _psnr("object", "held-out cameras"),
    "gaussians": Scored("Gaussians", "", "lower", 0, ("size", "", "gaussians")),
    "iou_object": Scored("IoU of the object's outline", "", "higher", 3),
    "iou_human": Scored("IoU of the human's outline", "", "higher", 3),
    "scene_over_human": Scored("share of the scene in the human's mask", "", "lower", 3),
    "drift_of_path": Scored("object's position error over its path", "", "lower", 3),
}


def scored_values(evaluation: Mapping[str, Any]) -> dict[str, Value]:
    """Every number of MEASURES in an evaluation.json of a stress run."""
    usual, own = measures_of(evaluation), evaluation[STRESS]
    absent = NotComputed("this evaluation has no such score")
    found: dict[str, Value] = {}
    for name, measure in MEASURES.items():
        if measure.place is not None:
            found[name] = usual.get(measure.place, absent)
            continue
        found[name] = from_json(own[name])
    return found
