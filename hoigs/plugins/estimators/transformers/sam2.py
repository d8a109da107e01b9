"""estimator:transformers-sam2: SAM 2's video masks, from a point or a box in one frame.

Ravi et al. 2024. Frames are fed one at a time, forwards from the prompt to the end and then
backwards to the start. Frames that the model no longer attends to are dropped, so that memory does
not grow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    Estimates,
    Estimator,
    LazyFrames,
    PromptPoint,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.plugins.estimators.tools import settings_key
from hoigs.plugins.estimators.transformers.models import (
    Box,
    Detection,
    Detector,
    ModelConfig,
    device_of,
    library,
    load,
    place_of,
    ready,
)

KEY = "estimator:transformers-sam2"
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, as SAM 2 was trained
PROBES = 12  # frames in which a detector looks for the best box


class PromptConfig(ComponentConfig):
    """Where an entity is, in one frame; pixels of the video."""

    frame: int = Field(default=0, ge=0, description="frame of the video")
    points: list[tuple[float, float]] = Field(default_factory=list, description="points on it")
    outside: list[tuple[float, float]] = Field(default_factory=list, description="points not on it")
    box: Box | None = Field(default=None, description="its box x0, y0, x1, y1")

    @model_validator(mode="after")
    def _shows_it(self) -> Self:
        if not self.points and self.box is None:
            raise ValueError("give `points` on it, or its `box`")
        return self


class TransformersSam2Config(ModelConfig):
    """Settings of `estimator:transformers-sam2`."""

    prompts: dict[str, PromptConfig] = Field(
        default_factory=dict,
        description="by entity, where it is; overrides the prompts of the request",
    )
    detector: str | None = Field(
        default=None,
        description="checkpoint of a detector, such as RT-DETR, that finds entities without a "
        "prompt by their text or name",
    )
    threshold: float = Field(
        default=0.4, ge=0, le=1, description="lowest score of a detector's box"
    )


class TransformersSam2Estimator(Estimator):
    """Masks of each entity by SAM 2. Prompts of the settings override those of the request."""

    Config: ClassVar = TransformersSam2Config
    config: TransformersSam2Config
    provides = frozenset({"masks"})

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        place = place_of(self.config.checkpoint, video, KEY)
        entities = self._prompted(video)
        made_from = {"place": place, "entities": entities, "frames": video.numbers}
        folder = video.work / f"transformers-sam2-{settings_key(made_from)}"
        if not (folder / "done").is_file():
            self._run(place, entities, folder, video, progress)
            (folder / "done").touch()
        progress(1.0, "masks")

        def masks_of(name: str) -> LazyFrames:
            return LazyFrames(video.frames, lambda i: _load(folder / name / f"{i:05d}.png"))

        masks = {entity.name: masks_of(entity.name) for entity in entities}
        return Estimates(EntityMasks(masks, None, f"{self.config.checkpoint}, SAM 2"))

    def _prompted(self, video: VideoRequest) -> list[EntityRequest]:
        """The entities, each with a point or a box as its prompt."""
        prompts = {name: _request(name, prompt) for name, prompt in self.config.prompts.items()}
        requested = {entity.name: entity for entity in video.entities} or prompts
        for name in prompts:
            if name not in requested:
                hint = did_you_mean(name, requested)
                raise HoigsError(f'{KEY}: prompts: "{name}" is not requested{hint}')
        entities = [prompts.get(name, entity) for name, entity in requested.items()]
        bare = [e for e in entities if not e.points and e.box is None]
        if bare and self.config.detector is None:
            names = ", ".join(f'"{e.name}"' for e in bare)
            raise HoigsError(
                f"{KEY}: SAM 2 needs a prompt: give a point or a box for {names} in "
                f"`prompts`, such as prompts: {{{bare[0].name}: {{frame: 0, box: [x0, y0, x1, y1]}}"
                "}, or a `detector`"
            )
        if bare:
            boxes = self._detected(bare, video)
            entities = [boxes.get(e.name, e) for e in entities]
        for entity in entities:
            if not 0 <= entity.frame < video.frames:
                raise HoigsError(
                    f"{KEY}: the prompt of {entity.name} is in frame {entity.frame}; the video has "
                    f"{video.frames}"
                )
        return entities

    def _detected(self, bare: list[EntityRequest], video: VideoRequest) -> dict[str, EntityRequest]:
        """Entities with the best box of a few frames spread over the video."""
        assert self.config.detector is not None
        detector = Detector(
            self.config.detector, video, KEY, self.config.device, self.config.threshold
        )
        labels = {entity.name: detector.label_of(entity) for entity in bare}
        best: dict[str, tuple[int, Detection]] = {}
        for i in video.numbers[:: -(-len(video.numbers) // PROBES)]:
            image = video.frame(i)
            for name, label in labels.items():
                found = detector.find(image, label)
                if found and (name not in best or found[0].score > best[name][1].score):
                    best[name] = (i, found[0])
        lost = [f'"{name}" (as {labels[name]})' for name in labels if name not in best]
        if lost:
            raise HoigsError(
                f"{KEY}: {self.config.detector} finds no {', '.join(lost)} above "
                f"{self.config.threshold}: give a point or a box in `prompts`"
            )
        return {
            e.name: EntityRequest(
                e.name, e.kind, e.text, box=best[e.name][1].box, frame=best[e.name][0]
            )
            for e in bare
        }

    def _run(
        self,
        place: str,
        entities: list[EntityRequest],
        folder: Path,
        video: VideoRequest,
        progress: Progress,
    ) -> None:
        model = load(library(KEY).Sam2VideoModel, place, KEY)
        tracker = _Tracker(ready(model, device_of(self.config.device), self.config.half), video)
        for entity in entities:
            (folder / entity.name).mkdir(parents=True, exist_ok=True)
        total, done = len(video.numbers) * len({e.frame for e in entities}), 0
        for start in sorted({entity.frame for entity in entities}):
            group = [entity for entity in entities if entity.frame == start]
            forwards = [i for i in video.numbers if i > start]
            backwards = [i for i in reversed(video.numbers) if i < start]
            for numbers in ([start, *forwards], [start, *backwards]):
                for i, masks in tracker.follow(group, numbers):
                    for entity, mask in zip(group, masks, strict=True):
                        _save(mask, folder / entity.name / f"{i:05d}.png")
                    done += 1
                    progress(min(done / total, 1.0), "masks")


class _Tracker:
    """SAM 2 over a sequence of frames."""

    def __init__(self, model: Any, video: VideoRequest) -> None:
        self.model, self.video = model, video
        self.size = int(model.config.prompt_encoder_config.image_size)
        # frames back that the model attends to; older ones are dropped
        self.reach = max(model.num_maskmem, model.config.max_object_pointers_in_encoder) + 1

    def follow(
        self, entities: list[EntityRequest], numbers: Iterable[int]
    ) -> Iterator[tuple[int, Bool[Tensor, "E H W"]]]:
        """Frame number and the masks, in the order of `entities`, which all have their prompt in
        the first of `numbers`."""
        session = library(KEY).Sam2VideoInferenceSession(
            inference_device=self.model.device,
            inference_state_device=self.model.device,
            dtype=self.model.dtype,
        )
        for entity in entities:
            self._prompt(session, entity)
        session.obj_with_new_inputs = list(range(len(entities)))
        for step, i in enumerate(numbers):
            yield i, self._step(session, step, self._pixels(self.video.frame(i)))

    @torch.inference_mode()
    def _step(self, session: Any, step: int, pixels: Tensor) -> Bool[Tensor, "E H W"]:
        found = self.model(inference_session=session, frame=pixels, frame_idx=step)
        session.processed_frames.pop(step)
        for outputs in session.output_dict_per_obj.values():
            outputs["non_cond_frame_outputs"].pop(step - self.reach, None)
        size = (self.video.height, self.video.width)
        logits = torch.nn.functional.interpolate(
            found.pred_masks.float(), size, mode="bilinear", align_corners=False
        )
        return logits[:, 0] > 0

    def _prompt(self, session: Any, entity: EntityRequest) -> None:
        """Points with label 1 on it and 0 beside it; a box is two points with labels 2 and 3."""
        points = [(p.x, p.y) for p in entity.points]
        labels = [int(p.inside) for p in entity.points]
        if entity.box is not None:
            points = [entity.box[:2], entity.box[2:], *points]
            labels = [2, 3, *labels]
        scale = torch.tensor([self.size / self.video.width, self.size / self.video.height])
        index = session.obj_id_to_idx(len(session.obj_ids))
        session.add_point_inputs(
            index,
            0,
            {
                "point_coords": (torch.tensor(points, dtype=torch.float32) * scale)[None, None],
                "point_labels": torch.tensor(labels, dtype=torch.int32)[None, None],
            },
        )

    def _pixels(self, image: np.ndarray) -> Float[Tensor, "1 3 S S"]:
        """A square of the model's size; SAM 2 does not keep proportions."""
        rgb = torch.from_numpy(np.array(image)).to(self.model.device).permute(2, 0, 1)[None]
        rgb = torch.nn.functional.interpolate(
            rgb.float() / 255, (self.size, self.size), mode="bilinear", antialias=True
        )
        mean, std = (rgb.new_tensor(values).view(1, 3, 1, 1) for values in (MEAN, STD))
        return ((rgb - mean) / std).to(self.model.dtype)


def _request(name: str, prompt: PromptConfig) -> EntityRequest:
    points = [PromptPoint(x, y) for x, y in prompt.points]
    points += [PromptPoint(x, y, inside=False) for x, y in prompt.outside]
    return EntityRequest(name, points=tuple(points), box=prompt.box, frame=prompt.frame)


def _save(mask: Bool[Tensor, "H W"], path: Path) -> None:
    from PIL import Image

    half = path.with_suffix(".part")
    Image.fromarray(mask.cpu().numpy()).save(half, format="PNG")
    half.replace(path)


def _load(path: Path) -> Bool[np.ndarray, "H W"]:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image).astype(bool)
