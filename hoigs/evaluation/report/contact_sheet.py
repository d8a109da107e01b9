"""contact_sheet: a PNG with frames of the video above their reconstructions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hoigs.core.files.whole_files import written_whole
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.evaluation.report.draw import draw, picture

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
