"""estimator:transformers-pose: ViTPose in boxes of a detector, or in boxes that are given.

Xu et al. 2022. It sees COCO's 17 keypoints (or 133, if trained so) in the image; none in space.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityRequest,
    Estimates,
    Estimator,
    VideoRequest,
    landmarks_from_keypoints,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.plugins.estimators.frame_files import FileDiagnostics, absent, load_array, require_count
from hoigs.plugins.estimators.landmarks_files import CONVENTIONS
from hoigs.plugins.estimators.tools import settings_key
from hoigs.plugins.estimators.transformers.models import (
    Box,
    Detector,
    ModelConfig,
    device_of,
    follow,
    library,
    load,
    place_of,
    ready,
    to_model,
)

KEY = "estimator:transformers-pose"


class TransformersPoseConfig(ModelConfig):
    """Settings of `estimator:transformers-pose`."""

    detector: str | None = Field(
        default=None, description="checkpoint of a detector of people, such as RT-DETR"
    )
    boxes: Path | None = Field(
        default=None,
        description="in place of a detector: an .npy file [F, 4] of x0, y0, x1, y1 in pixels, NaN "
        "in frames without a person; relative to the video's folder",
    )
    threshold: float = Field(default=0.3, ge=0, le=1, description="lowest score of a box")
    least: float = Field(
        default=0.2, ge=0, le=1, description="lowest score of a keypoint that is kept"
    )

    @model_validator(mode="after")
    def _knows_where_people_are(self) -> Self:
        if (self.detector is None) == (self.boxes is None):
            raise ValueError("ViTPose needs a box of the person: give either `detector` or `boxes`")
        return self


class TransformersPoseEstimator(Estimator):
    """Landmarks of the one person of a video by ViTPose."""

    Config: ClassVar = TransformersPoseConfig
    config: TransformersPoseConfig
    provides = frozenset({"landmarks"})

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        people = [e for e in video.entities if e.kind == "human"] or [
            EntityRequest("human", "human")
        ]
        if len(people) > 1:
            raise HoigsError(f"{KEY} follows one person, {len(people)} are requested")
        place = place_of(self.config.checkpoint, video, KEY)
        given = self._given(video)
        out = video.work / f"transformers-pose-{self._graph_key(place, given, video)}.npy"
        if not out.is_file():
            keypoints = self._run(place, given, people[0], video, progress)
            out.parent.mkdir(parents=True, exist_ok=True)
            half = out.with_suffix(".part")
            with half.open("wb") as file:
                np.save(file, keypoints)
            half.replace(out)
        keypoints = np.load(out, allow_pickle=False)
        keypoints[..., 2] = np.where(keypoints[..., 2] >= self.config.least, keypoints[..., 2], 0.0)
        name, targets = CONVENTIONS[keypoints.shape[1]]
        progress(1.0, "landmarks")
        text = f"{self.config.checkpoint}, {name}"
        return Estimates(
            landmarks={people[0].name: landmarks_from_keypoints(keypoints, targets, text)}
        )

    def _graph_key(self, place: str, given: np.ndarray | None, video: VideoRequest) -> str:
        boxes = None if given is None else given.tolist()
        return settings_key(
            {
                "place": place, "boxes": boxes, "detector": self.config.detector,
                "threshold": self.config.threshold, "frames": video.numbers,
            }
        )  # fmt: skip

    def _given(self, video: VideoRequest) -> Float[np.ndarray, "F 4"] | None:
        if self.config.boxes is None:
            return None
        path = video.resolve(self.config.boxes)
        problems = FileDiagnostics(
            KEY, "Boxes come from your tracker: x0, y0, x1, y1 of one person."
        )
        array = None
        if path.is_file():
            array = load_array(path, problems)
        else:
            problems.add(absent(path))
        if array is not None:
            if array.ndim != 2 or array.shape[1] != 4:
                problems.add(f"{path}: an array of shape {array.shape}, expected [frames, 4]")
            else:
                require_count(len(array), path, video, problems)
        problems.raise_if_any()
        return np.asarray(array, np.float64)

    def _run(
        self,
        place: str,
        given: np.ndarray | None,
        person: EntityRequest,
        video: VideoRequest,
        progress: Progress,
    ) -> Float[np.ndarray, "F K 3"]:
        transformers = library(KEY)
        model = load(transformers.VitPoseForPoseEstimation, place, KEY)
        model = ready(model, device_of(self.config.device), self.config.half)
        processor = load(transformers.AutoImageProcessor, place, KEY)
        count = int(model.config.num_labels)
        if count not in CONVENTIONS:
            known = ", ".join(f"{k} ({name})" for k, (name, _) in CONVENTIONS.items())
            raise HoigsError(f"{KEY}: {place} finds {count} keypoints, expected one of {known}")
        finder, label = None, ""
        if self.config.detector is not None:
            finder = Detector(
                self.config.detector, video, KEY, self.config.device, self.config.threshold
            )
            label = finder.label_of(person)
        keypoints = np.full((video.frames, count, 3), np.nan, np.float32)
        last: Box | None = None
        for done, (i, image) in enumerate(video.sequence()):
            progress(done / len(video.numbers), "landmarks")
            if finder is not None:
                box = follow(finder.find(image, label), last)
            else:
                assert given is not None
                box = _usable(given[i])
            if box is not None:
                keypoints[i] = _pose(model, processor, image, box)
                last = box
        return keypoints


def _usable(row: Float[np.ndarray, "4"]) -> Box | None:
    if not np.isfinite(row).all() or row[2] - row[0] < 1 or row[3] - row[1] < 1:
        return None
    x0, y0, x1, y1 = row.tolist()
    return (x0, y0, x1, y1)


@torch.inference_mode()
def _pose(model: Any, processor: Any, image: np.ndarray, box: Box) -> Float[np.ndarray, "K 3"]:
    """x, y, score of the keypoints of the person in the box."""
    corner = [[[box[0], box[1], box[2] - box[0], box[3] - box[1]]]]
    inputs = to_model(processor(images=image, boxes=corner, return_tensors="pt"), model)
    if getattr(model.config.backbone_config, "num_experts", 1) > 1:
        # ViTPose+: expert 0 is COCO's
        inputs["dataset_index"] = torch.zeros(1, dtype=torch.int64, device=model.device)
    outputs = model(**inputs)
    outputs.heatmaps = outputs.heatmaps.float()
    found = processor.post_process_pose_estimation(outputs, boxes=corner)[0][0]
    xy, score = found["keypoints"].float(), found["scores"].float().reshape(-1, 1)
    return torch.cat((xy, score.clamp(0, 1)), 1).cpu().numpy()
