"""Pictures of a run, encoded as data URIs for a page without other files."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from PIL import Image

from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip, Frame
from hoigs.evaluation.orbits import orbit_cameras
from hoigs.evaluation.protocol import NotComputed
from hoigs.evaluation.report.draw import (
    cut_out,
    depth_picture,
    depth_range,
    draw,
    error_picture,
    picture,
)
from hoigs.evaluation.scores import Evaluation, FrameScores
from hoigs.metrics.regions import default_band, region_masks

Item = TypeVar("Item")

PLAYBACK_FRAMES, ORBIT_FRAMES, COMPARED, HELD_OUT = 48, 36, 6, 3
PANEL_WIDTH, COMPARE_WIDTH = 400, 720
SEQUENCE, SEQUENCE_WIDTH = (
    24,
    360,
)  # frames of the player, and the width of each of its three panels
PLAYBACK_BYTES, ORBIT_BYTES = 2_000_000, 1_200_000


@dataclass(frozen=True)
class Moving:
    """Pictures that are played one after the other, as data URIs, each with a label."""

    pictures: list[str]
    labels: list[str]
    interval_ms: float


@dataclass(frozen=True)
class Comparison:
    """One scored frame as data URIs: the video, the render, where they differ."""

    label: str
    score: str
    video: str
    render: str
    error: str
    thumb: str


@dataclass(frozen=True)
class Cutout:
    """One entity drawn alone, with transparency."""

    name: str
    kind: str
    gaussians: int
    image: str


def playback(model: SceneModel, clip: Clip) -> Moving:
    """The video beside its reconstruction, over the whole clip, from the clip's cameras."""
    count = min(PLAYBACK_FRAMES, len(clip))
    positions = [round(i * (len(clip) - 1) / max(1, count - 1)) for i in range(count)]
    seconds = len(clip) / clip.fps
    panels, labels = [], []
    for position in positions:
        frame = clip[position]
        render = picture(draw(model, frame.moment, frame.camera).color)
        panels.append(beside(frame.image.numpy(), render))
        labels.append(f"frame {frame.moment.index}")
    return Moving(within(panels, PLAYBACK_BYTES), labels, 1000 * seconds / count)


def frozen_orbit(
    model: SceneModel, clip: Clip, position: int
) -> tuple[Moving, tuple[float, float]]:
    """One moment seen from a swinging camera: colour beside depth; and the range of depths."""
    moment = clip.moments[position]
    cameras = orbit_cameras(clip, model, ORBIT_FRAMES, position=position)
    span = depth_range(draw(model, moment, cameras[0]))
    panels = []
    for camera in cameras:
        output = draw(model, moment, camera)
        panels.append(beside(picture(output.color), depth_picture(output, span)))
    labels = [f"view {i + 1}" for i in range(len(panels))]
    return Moving(within(panels, ORBIT_BYTES), labels, 90), span


def cutouts(model: SceneModel, clip: Clip, position: int) -> list[Cutout]:
    """Every entity rendered alone at one moment."""
    moment, camera = clip.moments[position], clip.cameras[position]
    return [
        Cutout(
            name,
            model.entity(name).kind,
            len(model.entity(name)),
            still(cut_out(draw(model, moment, camera, [name])), PANEL_WIDTH, 80),
        )
        for name in model.entities
    ]


def comparisons(model: SceneModel, clip: Clip, evaluation: Evaluation) -> list[Comparison]:
    """Some scored frames of each view, evenly chosen."""
    made = []
    for view in evaluation.views:
        held_out = view.name == "held-out cameras"
        source = clip.held_out if held_out else clip
        if source is None:
            continue
        name = "Held-out camera, frame" if held_out else view.name.capitalize()[:-1]
        chosen = evenly(view.frames, HELD_OUT if held_out else COMPARED)
        for scored in chosen:
            made.append(_compare(model, source[scored.position], scored, name))
    return made


def _compare(model: SceneModel, frame: Frame, scored: FrameScores, name: str) -> Comparison:
    output = draw(model, frame.moment, frame.camera)
    video, render = frame.image.numpy(), picture(output.color)
    words = []
    for region, word in (("full", "full"), ("human_object", "human + object")):
        value = scored.values[region]["psnr"]
        if not isinstance(value, NotComputed):
            words.append(f"{value:.1f} dB {word}")
    return Comparison(
        label=f"{name} {scored.index}",
        score=" · ".join(words),
        video=still(video, COMPARE_WIDTH, 84),
        render=still(render, COMPARE_WIDTH, 84),
        error=still(error_picture(output.color, frame.rgb), COMPARE_WIDTH, 65),
        thumb=still(render, 120, 70),
    )


def scored_sequence(model: SceneModel, clip: Clip, evaluation: Evaluation) -> Moving:
    """The scored frames of the video in order: video | render | error."""
    frames = [
        f for view in evaluation.views if view.name != "held-out cameras" for f in view.frames
    ]
    pictures, labels = [], []
    for scored in evenly(sorted(frames, key=lambda f: f.index), SEQUENCE):
        frame = clip[scored.position]
        color = draw(model, frame.moment, frame.camera).color
        panels = (frame.image.numpy(), picture(color), error_picture(color, frame.rgb))
        pictures.append(still(np.concatenate(panels, 1), 3 * SEQUENCE_WIDTH, 70))
        labels.append(f"frame {scored.index}")
    return Moving(pictures, labels, 250)


def key_position(clip: Clip, samples: int = 24) -> int:
    """Position of the frame with the largest interaction region; the middle if there is none."""
    band = default_band(clip.cameras[0].width, clip.cameras[0].height)
    best, area = len(clip) // 2, 0
    for position in evenly(range(len(clip)), samples):
        inside = int(region_masks(clip[position], clip.kinds, band)["interaction"].sum())
        if inside > area:
            best, area = position, inside
    return best


def evenly(items: Sequence[Item], count: int) -> list[Item]:
    """At most `count` items, evenly spaced."""
    if len(items) <= count:
        return list(items)
    return [items[int((i + 0.5) * len(items) / count)] for i in range(count)]


def beside(left: np.ndarray, right: np.ndarray) -> Image.Image:
    """Two images of one size side by side, each at most PANEL_WIDTH wide."""
    width = min(PANEL_WIDTH, left.shape[1])
    panels = [_fit(Image.fromarray(image), width) for image in (left, right)]
    pair = Image.new("RGB", (2 * width, panels[0].height))
    pair.paste(panels[0], (0, 0))
    pair.paste(panels[1], (width, 0))
    return pair


def within(images: Sequence[Image.Image], limit: int) -> list[str]:
    """Images as data URIs, at the best quality at which all together stay under `limit` bytes."""
    data: list[bytes] = []
    for quality in (84, 70, 55, 40, 25):
        data = [_webp(image, quality, method=2) for image in images]
        if sum(map(len, data)) <= limit:
            break
    return [_uri(one, "webp") for one in data]


def still(image: np.ndarray, width: int, quality: int) -> str:
    """A WebP as a data URI, at most `width` wide; four channels keep their transparency."""
    shown = _fit(Image.fromarray(image), min(width, image.shape[1]))
    return _uri(_webp(shown, quality, method=4), "webp")


def _webp(image: Image.Image, quality: int, method: int) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=quality, method=method)
    return buffer.getvalue()


def _fit(image: Image.Image, width: int) -> Image.Image:
    if image.width == width:
        return image
    height = max(1, round(image.height * width / image.width))
    return image.resize((width, height), Image.Resampling.LANCZOS)


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
