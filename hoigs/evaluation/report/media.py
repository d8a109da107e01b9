"""Pictures and animations of a run, encoded as data URIs for a page without other files."""

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


def playback(model: SceneModel, clip: Clip) -> str:
    """The video beside its reconstruction, over the whole clip, from the clip's cameras."""
    count = min(PLAYBACK_FRAMES, len(clip))
    positions = [round(i * (len(clip) - 1) / max(1, count - 1)) for i in range(count)]
    seconds = len(clip) / clip.fps
    panels = []
    for position in positions:
        frame = clip[position]
        render = picture(draw(model, frame.moment, frame.camera).color)
        panels.append(beside(frame.image.numpy(), render))
    return animation(panels, 1000 * seconds / count, PLAYBACK_BYTES)


def frozen_orbit(model: SceneModel, clip: Clip, position: int) -> str:
    """One moment seen from a swinging camera: colour beside depth."""
    moment = clip.moments[position]
    cameras = orbit_cameras(clip, model, ORBIT_FRAMES, position=position)
    span = depth_range(draw(model, moment, cameras[0]))
    panels = []
    for camera in cameras:
        output = draw(model, moment, camera)
        panels.append(beside(picture(output.color), depth_picture(output, span)))
    return animation(panels, 90, ORBIT_BYTES)


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


def scored_sequence(model: SceneModel, clip: Clip, evaluation: Evaluation) -> list[tuple[str, str]]:
    """The scored frames of the video in order: label, and video | render | error as a data URI."""
    frames = [
        f for view in evaluation.views if view.name != "held-out cameras" for f in view.frames
    ]
    made = []
    for scored in evenly(sorted(frames, key=lambda f: f.index), SEQUENCE):
        frame = clip[scored.position]
        color = draw(model, frame.moment, frame.camera).color
        panels = (frame.image.numpy(), picture(color), error_picture(color, frame.rgb))
        row = np.concatenate(panels, 1)
        made.append((f"frame {scored.index}", still(row, 3 * SEQUENCE_WIDTH, 70)))
    return made


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


def animation(frames: Sequence[Image.Image], duration_ms: float, limit: int) -> str:
    """A looping WebP as a data URI, at the best quality that stays under `limit` bytes."""
    data = b""
    for quality in (84, 70, 55, 40, 25):
        buffer = io.BytesIO()
        frames[0].save(
            buffer, "WEBP", save_all=True, append_images=list(frames[1:]), loop=0,
            duration=max(20, round(duration_ms)), quality=quality, method=2,
        )  # fmt: skip
        data = buffer.getvalue()
        if len(data) <= limit:
            break
    return _uri(data, "webp")


def still(image: np.ndarray, width: int, quality: int) -> str:
    """A WebP as a data URI, at most `width` wide; four channels keep their transparency."""
    buffer = io.BytesIO()
    shown = _fit(Image.fromarray(image), min(width, image.shape[1]))
    shown.save(buffer, "WEBP", quality=quality, method=4)
    return _uri(buffer.getvalue(), "webp")


def _fit(image: Image.Image, width: int) -> Image.Image:
    if image.width == width:
        return image
    height = max(1, round(image.height * width / image.width))
    return image.resize((width, height), Image.Resampling.LANCZOS)


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
