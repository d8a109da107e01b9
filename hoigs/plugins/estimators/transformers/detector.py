"""Boxes of people and objects, by a detector of transformers such as RT-DETR."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.estimator import EntityRequest, VideoRequest
from hoigs.plugins.estimators.transformers.models import (
    Device,
    device_of,
    library,
    load,
    place_of,
    ready,
    to_model,
)

Box = tuple[float, float, float, float]  # x0, y0, x1, y1, pixels


@dataclass(frozen=True)
class Detection:
    """A box and how sure the detector is of it, 0..1."""

    box: Box
    score: float


class Detector:
    """A detector of transformers.

    Args:
        checkpoint: as in the estimators' settings. key: of the estimator that uses it, for errors.
        threshold: lowest score of a box.
    """

    def __init__(
        self, checkpoint: str, video: VideoRequest, key: str, device: Device, threshold: float
    ) -> None:
        transformers = library(key)
        place = place_of(checkpoint, video, key)
        model = load(transformers.AutoModelForObjectDetection, place, key)
        self.model = ready(model, device_of(device), half=False)
        self.processor = load(transformers.AutoImageProcessor, place, key)
        self.labels = {int(i): str(name) for i, name in self.model.config.id2label.items()}
        self.key, self.checkpoint, self.threshold = key, checkpoint, threshold

    def label_of(self, entity: EntityRequest) -> str:
        """The detector's word for an entity: its text or name; people are persons.

        Raises:
            HoigsError: the detector has no label of that name.
        """
        words = [entity.text or entity.name] + (["person"] if entity.kind == "human" else [])
        known = {name.lower(): name for name in self.labels.values()}
        for word in words:
            if word.lower() in known:
                return known[word.lower()]
        raise HoigsError(
            f'{self.key}: {self.checkpoint} has no label "{words[0]}"'
            f"{did_you_mean(words[0].lower(), known)}; set the entity's `text` to one of its "
            "labels, or give a box or points"
        )

    @torch.inference_mode()
    def find(self, image: np.ndarray, label: str) -> list[Detection]:
        """All boxes of one label, the highest score first."""
        inputs = to_model(self.processor(images=image, return_tensors="pt"), self.model)
        found = self.processor.post_process_object_detection(
            self.model(**inputs), threshold=self.threshold, target_sizes=[image.shape[:2]]
        )[0]
        boxes = [
            Detection(_inside(box, image), score)
            for box, score, number in zip(
                found["boxes"].tolist(), found["scores"].tolist(), found["labels"].tolist(),
                strict=True,
            )
            if self.labels.get(number) == label
        ]  # fmt: skip
        boxes = [b for b in boxes if b.box[2] - b.box[0] >= 1 and b.box[3] - b.box[1] >= 1]
        return sorted(boxes, key=lambda detection: -detection.score)


def follow(found: list[Detection], last: Box | None) -> Box | None:
    """The box with the largest sum of score and overlap with `last`; None without boxes."""
    if not found:
        return None
    if last is None:
        return found[0].box
    return max(found, key=lambda detection: detection.score + overlap(detection.box, last)).box


def overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)]
    return width * height / (sum(areas) - width * height)


def _inside(box: Any, image: np.ndarray) -> Box:
    height, width = image.shape[:2]
    x0, y0, x1, y1 = box
    return (max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height)))
