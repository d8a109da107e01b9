"""What a stressed training is judged by: numbers of its evaluation, and a few more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.results import Measure, measures_of

STRESS = "stress"  # in evaluation.json, beside the evaluation's own


@dataclass(frozen=True)
class Judged:
    """One number of a training.

    Attributes:
        title: on paper. place: in `measures_of`; None is a number of `stress.observe`.
        better: which way is good.
    """

    title: str
    unit: str
    better: Literal["higher", "lower"]
    digits: int = 2
    place: Measure | None = None


def _psnr(region: str, view: str = "test frames") -> Judged:
    words = region.replace("_", " + ")
    where = "" if view == "test frames" else ", held-out cameras"
    return Judged(f"PSNR, {words}{where}", "dB", "higher", 2, (view, region, "psnr"))


MEASURES: Mapping[str, Judged] = {
    "psnr_full": _psnr("full"),
    "psnr_human": _psnr("human"),
    "psnr_object": _psnr("object"),
    "psnr_human_object": _psnr("human_object"),
    "held_out_psnr_full": _psnr("full", "held-out cameras"),
    "held_out_psnr_human_object": _psnr("human_object", "held-out cameras"),
    "held_out_psnr_object": _psnr("object", "held-out cameras"),
    "gaussians": Judged("Gaussians", "", "lower", 0, ("size", "", "gaussians")),
    "iou_object": Judged("IoU of the object's outline", "", "higher", 3),
    "iou_human": Judged("IoU of the human's outline", "", "higher", 3),
    "scene_over_human": Judged("scene within the human's mask", "", "lower", 3),
    "drift_of_path": Judged("object's error of place, of its path", "", "lower", 3),
}


def judged_values(evaluation: Mapping[str, Any]) -> dict[str, Value]:
    """Every number of MEASURES in an evaluation.json of a stress run."""
    usual, own = measures_of(evaluation), evaluation[STRESS]
    absent = NotComputed("this evaluation has no such score")
    found: dict[str, Value] = {}
    for name, measure in MEASURES.items():
        if measure.place is not None:
            found[name] = usual.get(measure.place, absent)
            continue
        value = own[name]
        found[name] = NotComputed(value["not_computed"]) if isinstance(value, dict) else value
    return found
