"""prior:transformers-pose: ViTPose in boxes of a detector, or in boxes that are given.

Xu et al. 2022. It sees COCO's 17 keypoints (or 133, if trained so) in the image; none in space.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator

from hoigs.core.errors import HoigsError
from hoigs.core.video_prior import (
    EntityRequest,
    Evidence,
    Progress,
    VideoPrior,
    VideoRequest,
    landmarks_from_keypoints,
    no_progress,
)
from hoigs.plugins.priors.video_detector import Box, Detector, follow
from hoigs.plugins.priors.video_files import Problems, absent, load_array, require_count
from hoigs.plugins.priors.video_keypoints import CONVENTIONS
from hoigs.plugins.priors.video_subprocess import settings_key
from hoigs.plugins.priors.video_transformers import (
    Device,
    ModelConfig,
    device_of,
    library,
    load,
    place_of,
    ready,
    to_model,
)

KEY = "prior:transformers-pose"


class TransformersPoseConfig(ModelConfig):
    """Settings of `prior:transformers-pose`."""

    detector: str | None = Field(
        default=None, description="checkpoint of a detector of people, such as RT-DETR"
    )
    boxes: Path | None = Field(
        default=None,
        description="in place of a detector: an .npy file [F, 4] of x0, y0, x1, y1 in pixels, NaN "
        "where nobody is; relative to the video's folder",
    )
    threshold: float = Field(default=0.3, ge=0, le=1, description="least score of a box")
    least: float = Field(default=0.2, ge=0, le=1, description="score of a keypoint to be kept")

    @model_validator(mode="after")
    def _knows_where_people_are(self) -> Self:
        if (self.detector is None) == (self.boxes is None):
            raise ValueError("ViTPose looks into boxes: give `detector` or `boxes`, one of them")
        return self


class TransformersPosePrior(VideoPrior):
    """Landmarks of the one person of a video by ViTPose.

    Args: as TransformersPoseConfig describes them.
    """

    provides = frozenset({"landmarks"})

    def __init__(
        self,
        checkpoint: str,
        device: Device = "auto",
        half: bool = False,
        detector: str | None = None,
        boxes: str | Path | None = None,
        threshold: float = 0.3,
        least: float = 0.2,
    ) -> None:
        self.checkpoint, self.device, self.half = checkpoint, device, half
        self.detector, self.boxes = detector, None if boxes is None else Path(boxes)
        self.threshold, self.least = threshold, least

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Evidence:
        people = [e for e in video.entities if e.kind == "human"] or [
            EntityRequest("human", "human")
        ]
        if len(people) > 1:
            raise HoigsError(f"{KEY} follows one person, {len(people)} are asked for")
        place = place_of(self.checkpoint, video, KEY)
        given = self._given(video)
        out = video.work / f"transformers-pose-{self._stamp(place, given, video)}.npy"
        if not out.is_file():
            keypoints = self._run(place, given, people[0], video, progress)
            out.parent.mkdir(parents=True, exist_ok=True)
            half = out.with_suffix(".part")
            with half.open("wb") as file:
                np.save(file, keypoints)
            half.replace(out)
        keypoints = np.load(out, allow_pickle=False)
        keypoints[..., 2] = np.where(keypoints[..., 2] >= self.least, keypoints[..., 2], 0.0)
        name, targets = CONVENTIONS[keypoints.shape[1]]
        progress(1.0, "landmarks")
        text = f"{self.checkpoint}, {name}"
        return Evidence(
            landmarks={people[0].name: landmarks_from_keypoints(keypoints, targets, text)}
        )

    def _stamp(self, place: str, given: np.ndarray | None, video: VideoRequest) -> str:
        boxes = None if given is None else given.tolist()
        return settings_key(
            {
                "place": place, "boxes": boxes, "detector": self.detector,
                "threshold": self.threshold, "frames": video.numbers,
            }
        )  # fmt: skip

    def _given(self, video: VideoRequest) -> Float[np.ndarray, "F 4"] | None:
        if self.boxes is None:
            return None
        path = video.resolve(self.boxes)
        problems = Problems(KEY, "Boxes come from your tracker: x0, y0, x1, y1 of one person.")
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
        model = ready(model, device_of(self.device), self.half)
        processor = load(transformers.AutoImageProcessor, place, KEY)
        count = int(model.config.num_labels)
        if count not in CONVENTIONS:
            known = ", ".join(f"{k} ({name})" for k, (name, _) in CONVENTIONS.items())
            raise HoigsError(f"{KEY}: {place} finds {count} keypoints, expected one of {known}")
        finder, label = None, ""
        if self.detector is not None:
            finder = Detector(self.detector, video, KEY, self.device, self.threshold)
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
    """x, y, score of the keypoints of whoever is in the box."""
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
