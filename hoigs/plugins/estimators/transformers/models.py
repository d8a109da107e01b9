"""Models of transformers, from a folder on disk or from the hub. Weights are the user's.

Only classes of the installed library are used and only safetensors are read: neither code nor
pickles of a checkpoint are ever run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, PluginError, did_you_mean
from hoigs.core.interfaces.estimator import EntityRequest, VideoRequest
from hoigs.core.system import downloads as hub
from hoigs.plugins.estimators.frame_files import absent

_HUB = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
Device = Literal["auto", "cpu", "cuda"]


class ModelConfig(ComponentConfig):
    """Settings that the estimators with models of transformers share."""

    checkpoint: str = Field(
        description="folder of a transformers model, relative to the video's folder, or its name "
        "on the Hugging Face hub, from where it is downloaded once; mind its licence"
    )
    device: Device = Field(
        default="auto", description="where to compute; 'auto': CUDA where it is available"
    )
    half: bool = Field(
        default=False, description="compute in float16, with half the memory; for CUDA"
    )


def library(key: str) -> ModuleType:
    """transformers.

    Raises:
        PluginError: it is not installed.
    """
    try:
        import transformers
    except ImportError as error:
        raise PluginError(
            f"{key} needs transformers ({error}); pip install 'hoigs[estimators]'"
        ) from error
    return transformers


def device_of(device: Device) -> torch.device:
    """The device of a setting; "auto" is CUDA where there is one."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(device)


def place_of(checkpoint: str, video: VideoRequest, key: str) -> str:
    """A folder's path, or that in the hub's cache of a name on the hub, which is downloaded where
    it is not there yet.

    Raises:
        HoigsError: neither, or a folder that holds no model with safetensors; or the hub's cannot
            be had.
    """
    folder = video.resolve(Path(checkpoint))
    if not folder.is_dir():
        if _HUB.fullmatch(checkpoint):
            return str(hub.fetched(checkpoint))
        raise HoigsError(
            f"{key}: {absent(folder)}; expected the folder of a transformers model, with "
            "config.json and .safetensors in it, or a name on the hub, such as owner/model"
        )
    lacking = [] if (folder / "config.json").is_file() else ["config.json"]
    if not list(folder.glob("*.safetensors")):
        lacking.append("*.safetensors (other formats may run code when they are read)")
    if lacking:
        raise HoigsError(f"{key}: {folder} is no transformers model; it lacks {lacking}")
    return str(folder)


def load(kind: Any, place: str, key: str, **settings: Any) -> Any:
    """`kind.from_pretrained(place)`.

    Raises:
        HoigsError: it cannot be loaded, or the checkpoint has not all of the model's weights.
    """
    is_model = "Model" in kind.__name__ or issubclass(kind, torch.nn.Module)
    if is_model:
        settings |= {"use_safetensors": True, "output_loading_info": True}
    try:
        loaded = kind.from_pretrained(place, **settings)
    except Exception as error:  # its loaders raise anything on a damaged or unknown checkpoint
        reason = f"{type(error).__name__}: {error}"
        raise HoigsError(f"{key}: {place} cannot be loaded by {kind.__name__}: {reason}") from error
    if not is_model:
        return loaded
    model, report = loaded
    # counters of batches have no effect in inference, and older checkpoints have none
    missing = sorted(k for k in report["missing_keys"] if not k.endswith("num_batches_tracked"))
    if missing:  # transformers would fill them with random numbers
        raise HoigsError(
            f"{key}: {place} lacks {len(missing)} weights of {type(model).__name__}, such as "
            f"{missing[0]}: it is another kind of model"
        )
    return model


def ready(model: Any, device: torch.device, half: bool) -> Any:
    """The model for inference."""
    model = model.to(device).eval().requires_grad_(False)
    return model.half() if half else model


def to_model(inputs: Any, model: Any) -> dict[str, Any]:
    """A processor's tensors on the model's device, in its precision."""
    return {
        name: value.to(model.device, model.dtype if value.is_floating_point() else None)
        for name, value in inputs.items()
        if isinstance(value, torch.Tensor)
    }


# Boxes of people and objects, by a detector of transformers such as RT-DETR.

Box = tuple[float, float, float, float]  # x0, y0, x1, y1, pixels


@dataclass(frozen=True)
class Detection:
    """A box and how sure the detector is of it, 0..1."""

    box: Box
    score: float


class Detector:
    """A detector of transformers.

    Args:
        checkpoint: as in the estimators' settings. key: the estimator's key, for errors.
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
