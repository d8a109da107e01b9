"""Pictures of a run, encoded as data URIs for a page without other files."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.scene import SceneModel
from hoigs.core.system.files import written_whole
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, Frame
from hoigs.core.values.moment import Moment
from hoigs.evaluation.measure import orbit_cameras
from hoigs.evaluation.protocol import NotComputed
from hoigs.evaluation.scores import Evaluation, FrameScores
from hoigs.metrics.regions import default_band, region_masks

# Renders as 8-bit pictures: colour, false-colour depth and error, entities with alpha.

ERROR_FULL = 0.25  # absolute error, of colours in [0, 1], that is drawn white

DEPTH_DARKEST = 0.1  # of depth's colour map: what is darker is left for transparent pixels


@torch.no_grad()
def draw(
    model: SceneModel, moment: Moment, camera: Camera, only: Iterable[str] | None = None
) -> RenderOutput:
    """Render one view on the model's device, without gradients."""
    return model.render(moment.to(model.device), camera.to(model.device), only=only)


def picture(color: Float[Tensor, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
    """Values clamped to [0, 1] and rounded to 8 bits."""
    return (color.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def cut_out(output: RenderOutput) -> UInt8[np.ndarray, "H W 4"]:
    """A render as RGBA, with straight (not premultiplied) alpha."""
    alpha = output.alpha.clamp(0, 1)[..., None]
    straight = output.color / alpha.clamp_min(1e-3)
    return np.concatenate((picture(straight), picture(alpha)), -1)


def error_picture(
    color: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute error of the channels in false colour, from black (0) to white (ERROR_FULL)."""
    error = (color.clamp(0, 1) - target.to(color)).abs().mean(-1)
    return false_color(error / ERROR_FULL, "inferno")


def depth_range(output: RenderOutput) -> tuple[float, float]:
    """Percentiles 2 and 98 of the depth where the view is opaque, metres."""
    seen = output.expected_depth[output.alpha > 0.5]
    if len(seen) == 0:
        return 0.0, 1.0
    near, far = torch.quantile(seen[:: max(1, len(seen) // 100_000)], seen.new_tensor([0.02, 0.98]))
    return float(near), max(float(far), float(near) + 1e-3)


def depth_picture(output: RenderOutput, span: tuple[float, float]) -> UInt8[np.ndarray, "H W 3"]:
    """Depth in false colour, near is bright, darkened by transparency."""
    near, far = span
    closeness = (far - output.expected_depth) / (far - near)
    bright = DEPTH_DARKEST + (1 - DEPTH_DARKEST) * closeness.clamp(0, 1)
    shown = false_color(bright, "magma").astype(np.float32)
    return (shown * output.alpha.clamp(0, 1)[..., None].cpu().numpy()).round().astype(np.uint8)


def error_colors(count: int = 9) -> list[str]:
    """The colours of errors from 0 to ERROR_FULL, as #rrggbb."""
    return _hex(torch.linspace(0, 1, count), "inferno")


def depth_colors(count: int = 9) -> list[str]:
    """The colours of depths from near to far, as #rrggbb."""
    return _hex(torch.linspace(1, DEPTH_DARKEST, count), "magma")


def _hex(values: Float[Tensor, " N"], name: str) -> list[str]:
    return [f"#{bytes(color).hex()}" for color in false_color(values[None], name)[0]]


def false_color(values: Float[Tensor, "H W"], name: str) -> UInt8[np.ndarray, "H W 3"]:
    """Values in [0, 1], clamped, by one of matplotlib's maps."""
    mapped = matplotlib.colormaps[name](values.clamp(0, 1).cpu().numpy(), bytes=True)
    return np.ascontiguousarray(mapped[..., :3])


Item = TypeVar("Item")
PLAYBACK_FRAMES, ORBIT_FRAMES, COMPARED, HELD_OUT = 48, 36, 6, 3
PANEL_WIDTH, COMPARE_WIDTH = 400, 720
SEQUENCE, SEQUENCE_WIDTH = 24, 360  # frames of the player, and the width of its three panels
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
    made = []
    for name in model.entities:
        entity, drawn = model.entity(name), cut_out(draw(model, moment, camera, [name]))
        made.append(Cutout(name, entity.kind, len(entity), still(drawn, PANEL_WIDTH, 80)))
    return made


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
    views = [view for view in evaluation.views if view.name != "held-out cameras"]
    frames = [frame for view in views for frame in view.frames]
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


# contact_sheet: a PNG with frames of the video above their reconstructions.

INK, PAPER, QUIET = (28, 30, 34), (250, 249, 246), (120, 120, 118)
GAP, MARGIN, LABEL = 6, 18, 26


def contact_sheet(
    model: SceneModel,
    clip: Clip,
    frames: Sequence[int],
    out_png: Path | str,
    *,
    tile_width: int = 240,
    title: str | None = None,
) -> Path:
    """Write a PNG with one column a frame: video, render.

    Args:
        frames: positions in the clip, preferably of test frames.
        title: top line; by default the clip's name.

    Raises:
        ValueError: `frames` is empty.
    """
    if not frames:
        raise ValueError("a contact sheet needs at least one frame")
    columns = []
    for position in frames:
        frame = clip[position]
        render = picture(draw(model, frame.moment, frame.camera).color)
        split = next((name for name, chosen in clip.split.items() if position in chosen), "")
        label = f"{frame.moment.index} {split}".strip()
        columns.append((label, _tile(frame.image.numpy(), tile_width), _tile(render, tile_width)))
    tile_height = columns[0][1].height
    width = 2 * MARGIN + LABEL + len(columns) * (tile_width + GAP) - GAP
    height = 2 * MARGIN + 2 * LABEL + 2 * tile_height + GAP
    sheet = Image.new("RGB", (width, height), PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((MARGIN, MARGIN - 4), title or clip.name, INK, _font(17))
    top = MARGIN + 2 * LABEL
    for row, word in enumerate(("video", "hoigs")):
        _write_upright(sheet, word, top + row * (tile_height + GAP), tile_height)
    for i, (label, video, render_tile) in enumerate(columns):
        left = MARGIN + LABEL + i * (tile_width + GAP)
        pen.text((left, top - 20), f"frame {label}", QUIET, _font(13))
        sheet.paste(video, (left, top))
        sheet.paste(render_tile, (left, top + tile_height + GAP))
    path = Path(out_png)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as part:
        sheet.save(part, format="PNG", optimize=True)
    return path


def _tile(image: np.ndarray, width: int) -> Image.Image:
    height = round(image.shape[0] * width / image.shape[1])
    return Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS)


def _write_upright(sheet: Image.Image, word: str, top: int, height: int) -> None:
    """A row's name, read from bottom to top, at the left edge."""
    strip = Image.new("RGB", (height, LABEL), PAPER)
    ImageDraw.Draw(strip).text((height / 2, LABEL / 2 - 3), word, INK, _font(14), anchor="mm")
    sheet.paste(strip.rotate(90, expand=True), (MARGIN - 6, top))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
