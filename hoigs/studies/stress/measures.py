"""Measures that criteria refer to: numbers of the evaluation, and those of `observe`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip, Frame
from hoigs.evaluation.geometry import read_truth
from hoigs.evaluation.protocol import NotComputed, Value, from_json, to_json
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
    return {
        name: from_json(own[name]) if measure.place is None else usual.get(measure.place, absent)
        for name, measure in MEASURES.items()
    }


# Measures beyond those of evaluation: outlines, coverage, and drift of the object.

KINDS = ("scene", "human", "object")
SHORTEST_PATH = 0.01  # metres


@torch.no_grad()
def observe(
    model: SceneModel, clip: Clip, geometry: Mapping[str, Value]
) -> dict[str, float | dict[str, str]]:
    """Measures of a model on a clip's test frames that `evaluate` lacks, as JSON values.

    Args:
        geometry: of the evaluation on the same frames.
    """
    frames = [clip[p] for p in clip.split["test"]]
    shares = [_shares(model, frame) for frame in frames]
    found: dict[str, Value] = {
        "iou_object": _iou(model, clip, frames, shares, "object"),
        "iou_human": _iou(model, clip, frames, shares, "human"),
        "scene_over_human": _covered(model, clip, frames, shares),
        "drift_of_path": _drift(clip, geometry["object_translation"]),
    }
    return {n: to_json(v if isinstance(v, NotComputed) else round(v, 6)) for n, v in found.items()}


def _shares(model: SceneModel, frame: Frame) -> Float[Tensor, "H W 3"]:
    """Composited share of scene, humans and objects in each pixel."""
    state = model(frame.moment.to(model.device))
    rows = [
        torch.eye(3)[KINDS.index(model.entity(name).kind)].expand(len(gaussians), 3)
        for name, gaussians in state.gaussians.items()
    ]
    request = RenderRequest(features=torch.cat(rows).to(model.device))
    output = model.rasterize(state.joined(), frame.camera.to(model.device), request)
    assert output.features is not None
    return output.features.cpu()


def _iou(
    model: SceneModel,
    clip: Clip,
    frames: list[Frame],
    shares: list[Float[Tensor, "H W 3"]],
    kind: str,
) -> Value:
    """Mean IoU over frames that show the kind: pixels with a share above 0.5 against its masks."""
    if not model.names(kind):
        return NotComputed(f"the model does not separate the {kind} from the rest")

    def iou(true: Bool[Tensor, "H W"], share: Float[Tensor, "H W 3"]) -> Tensor:
        drawn = share[..., KINDS.index(kind)] > 0.5
        return (true & drawn).sum() / (true | drawn).sum()

    return _mean_over(kind, clip, frames, shares, iou)


def _covered(
    model: SceneModel, clip: Clip, frames: list[Frame], shares: list[Float[Tensor, "H W 3"]]
) -> Value:
    """Mean share of the scene in pixels of the human's mask."""
    if not model.names("human") or not model.names("scene"):
        return NotComputed("the model does not separate the human from the scene")
    return _mean_over("human", clip, frames, shares, lambda true, share: share[true][:, 0].mean())


def _mean_over(
    kind: str,
    clip: Clip,
    frames: list[Frame],
    shares: list[Float[Tensor, "H W 3"]],
    measure: Callable[[Bool[Tensor, "H W"], Float[Tensor, "H W 3"]], Tensor],
) -> Value:
    """Mean of a measure of masks and shares, over the frames that show the kind."""
    values = []
    for frame, share in zip(frames, shares, strict=True):
        true = torch.stack([m for n, m in frame.masks.items() if clip.kinds[n] == kind]).any(0)
        if true.any():
            values.append(float(measure(true, share)))
    return float(np.mean(values)) if values else NotComputed(f"no test frame shows the {kind}")


def _drift(clip: Clip, error: Value) -> Value:
    """The object's position error, relative to the length of its path."""
    if isinstance(error, NotComputed):
        return error
    truth = read_truth(clip)
    if isinstance(truth, NotComputed):
        return truth
    path = float(np.linalg.norm(np.diff(truth.translations, axis=0), axis=-1).sum())
    if path < SHORTEST_PATH:
        return NotComputed("the object stands still")
    return error / 1000 / path
