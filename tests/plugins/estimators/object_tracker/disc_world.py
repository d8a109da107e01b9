"""A textured disc that passes a person before a textured wall, and requests for its masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    Estimates,
    FramePrompt,
    PromptPoint,
    VideoRequest,
    checked,
)
from hoigs.plugins.estimators.object_tracker.estimator import ObjectTrackerEstimator

H, W, RADIUS, COUNT = 72, 108, 8, 14


def texture(seed: int, color: tuple[int, int, int], shape=(H, W + 60)) -> np.ndarray:
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(*shape, 3)), (2, 2, 0))
    return np.clip(np.array(color) + 18 * noise / noise.std(), 0, 255)


def places() -> list[tuple[float, float]]:
    """Of the disc: it swings past the person."""
    return [(16 + 5.2 * i, 40 + 14 * np.sin(i / 3)) for i in range(COUNT)]


def world(pan: float = 0.0, hidden: range = range(0)):
    """Frames, masks of the person, masks of the disc; `hidden`: frames with a board before it."""
    wall, ball = texture(0, (120, 130, 90)), texture(1, (200, 60, 50))
    y, x = np.mgrid[:H, :W] + 0.5
    frames, people, discs = [], [], []
    for i, (cx, cy) in enumerate(places()):
        image = wall[:, round(pan * i) :][:, :W].copy()
        person = (np.abs(x - 50 - 3 * np.sin(i)) < 8) & (y > 14)
        disc = np.hypot(x - cx, y - cy) < RADIUS
        image[person] = (70, 80, 150)
        rolled = np.roll(ball[:, :W], (round(cy), round(cx)), (0, 1))
        image[disc] = rolled[disc]
        if i in hidden:
            image[disc] = wall[:, round(pan * i) :][:, :W][disc]
            disc = np.zeros_like(disc)
        frames.append(image.astype(np.uint8))
        people.append(person & ~disc)
        discs.append(disc)
    return frames, people, discs


def request(tmp_path: Path, scene, prompts: tuple[FramePrompt, ...] = ()) -> VideoRequest:
    frames, people, _ = scene
    entity = EntityRequest("object", "object", further=prompts)
    return VideoRequest(
        len(frames), W, H, lambda i: frames[i], tmp_path, tmp_path, entities=(entity,),
        known=Estimates(EntityMasks({"human": people})),
    )  # fmt: skip


def click(frame: int, x: float | None = None, y: float | None = None) -> FramePrompt:
    cx, cy = places()[frame]
    return FramePrompt(frame, (PromptPoint(cx if x is None else x, cy if y is None else y),))


def masks_of(video: VideoRequest) -> EntityMasks:
    estimator = ObjectTrackerEstimator()
    found = checked(estimator.estimate(video), video, estimator).masks
    assert found is not None
    return found


def overlaps(found: EntityMasks, discs: list[np.ndarray]) -> np.ndarray:
    masks = [found.entities["object"][i] for i in range(len(discs))]
    return np.array([(m & d).sum() / max((m | d).sum(), 1) for m, d in zip(masks, discs)])
