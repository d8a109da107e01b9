"""estimator:transformers-depth: Depth Anything V2 and similar models, frame by frame.

Yang et al. 2024. Its plain models give disparity, the metric ones metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    DepthKind,
    DepthMaps,
    Estimates,
    Estimator,
    LazyFrames,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.plugins.estimators.tools import settings_key
from hoigs.plugins.estimators.transformers.models import (
    ModelConfig,
    device_of,
    library,
    load,
    place_of,
    ready,
    to_model,
)

KEY = "estimator:transformers-depth"
KINDS: dict[str, DepthKind] = {
    "zoedepth": "metric", "depth_pro": "metric", "glpn": "metric", "dpt": "disparity",
}  # fmt: skip


class TransformersDepthConfig(ModelConfig):
    """Settings of `estimator:transformers-depth`."""

    kind: DepthKind | None = Field(
        default=None, description="unit of the model's output; None derives it from the model"
    )


class TransformersDepthEstimator(Estimator):
    """Depth by a model of transformers for depth estimation.

    Frames are stored in the work folder as float16, and not estimated twice.
    """

    Config: ClassVar = TransformersDepthConfig
    config: TransformersDepthConfig
    provides = frozenset({"depth"})

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        place = place_of(self.config.checkpoint, video, KEY)
        folder = video.work / f"transformers-depth-{settings_key({'place': place})}"
        folder.mkdir(parents=True, exist_ok=True)
        kind = self._kind_of(place)
        todo = [i for i in video.numbers if not (folder / f"{i:05d}.npy").is_file()]
        if todo:
            self._run(todo, place, folder, video, progress)
        progress(1.0, "depth")

        def read(i: int) -> Float[np.ndarray, "H W"]:
            depth = np.load(folder / f"{i:05d}.npy", allow_pickle=False).astype(np.float32)
            unknown = ~np.isfinite(depth) | ((depth <= 0) if kind == "metric" else False)
            return np.where(unknown, np.float32(np.nan), depth)

        text = f"{self.config.checkpoint}, {kind}"
        return Estimates(depth=DepthMaps(LazyFrames(video.frames, read), kind, text))

    def _kind_of(self, place: str) -> DepthKind:
        config = load(library(KEY).AutoConfig, place, KEY)
        if self.config.kind is not None:
            return self.config.kind
        if config.model_type == "depth_anything":
            return "metric" if config.depth_estimation_type == "metric" else "disparity"
        if config.model_type in KINDS:
            return KINDS[config.model_type]
        raise HoigsError(
            f"{KEY}: whether {config.model_type} gives metres or disparity is not known: set "
            "`kind: metric` or `kind: disparity`"
        )

    def _run(
        self, todo: list[int], place: str, folder: Path, video: VideoRequest, progress: Progress
    ) -> None:
        transformers = library(KEY)
        model = load(transformers.AutoModelForDepthEstimation, place, KEY)
        model = ready(model, device_of(self.config.device), self.config.half)
        processor = load(transformers.AutoImageProcessor, place, KEY)
        for done, i in enumerate(todo):
            progress(done / len(todo), "depth")
            _save(_depth(model, processor, video.frame(i)), folder / f"{i:05d}.npy")


@torch.inference_mode()
def _depth(model: Any, processor: Any, image: np.ndarray) -> Float[np.ndarray, "H W"]:
    inputs = to_model(processor(images=image, return_tensors="pt"), model)
    size = [image.shape[:2]]
    found = processor.post_process_depth_estimation(model(**inputs), target_sizes=size)[0]
    return found["predicted_depth"].float().cpu().numpy()


def _save(depth: Float[np.ndarray, "H W"], path: Path) -> None:
    half = path.with_suffix(".part")
    with half.open("wb") as out:
        np.save(out, depth.astype(np.float16))
    half.replace(path)
