"""Moving pictures of a run: the video, its reconstruction, and bullet time.

    hoigs demo --out runs/demo --no-baseline
    python scripts/readme_film.py runs/demo --out docs/assets/demo.webp
    hoigs prepare juggle.mp4 --out clips/juggle --width 640
    hoigs train clips/juggle --out runs/juggle --set train.steps=1200 --set train.width=480
    python scripts/readme_film.py runs/juggle --crop 0.25,0,0.8,1 --part 132,186,2 \\
        --height 272 --quality 70 --out docs/assets/juggle.webp

All three panels show the same moment; while time stands still, only the camera of the third one
moves. Renders have twice the pixels of the picture, and are averaged.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from hoigs.core.values.between import camera_between, frame_numbers
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.evaluation.report.media import picture
from hoigs.runs.loaded_run import open_run
from hoigs.viewing.films import playback_of, source_frame
from hoigs.viewing.paths import film_path, frames_shown

TITLES = ("the video", "reconstruction", "bullet time")
GAP, HEAD = 8, 28  # pixels
GROUND, INK = (14, 16, 20), (214, 210, 202)
LARGEST = 3_000_000  # bytes


def frames(
    run: Path, clip: Path | None, height: int, crop: tuple[float, ...], part: tuple[int, ...]
) -> Iterator[tuple[Image.Image, float]]:
    """The pictures of the film, and the seconds that each is shown.

    Args:
        height: pixels of each panel. crop: left, top, right, bottom of what is shown, as fractions
            of the picture. part: first frame, last frame and step; empty for the whole clip.
    """
    loaded = open_run(run, clip=clip)
    numbers, fps = frame_numbers(loaded.clip)
    if part:
        numbers, fps = numbers[part[0] : part[1] + 1 : part[2]], fps / part[2]
    _, top, _, bottom = crop
    own = loaded.clip.cameras[0]
    full = 2 * height / (bottom - top)
    size = round(full * own.width / own.height), round(full)
    box = tuple(round(c * s) for c, s in zip(crop, (*size, *size), strict=True))
    width = round((box[2] - box[0]) / 2)
    around = film_path(loaded.model, loaded.clip, "bullet-time", numbers, fps)
    shown = frames_shown(loaded.clip, around)
    views = [(moment, camera.resized(*size)) for moment, camera in around]
    straight = [
        (moment, camera_between(loaded.clip, frame).resized(*size))
        for (moment, _), frame in zip(around, shown, strict=True)
    ]
    play = playback_of(loaded.model, [*views[::8], *straight[::8]])
    font = ImageFont.load_default(15)
    for (moment, own), (_, beside), frame in zip(straight, views, shown, strict=True):
        sheet = Image.new("RGB", (3 * width + 2 * GAP, height + HEAD), GROUND)
        draw = ImageDraw.Draw(sheet)
        panels = (
            _source(loaded.clip, frame),
            Image.fromarray(picture(play(moment, own).color)),
            Image.fromarray(picture(play(moment, beside).color)),
        )
        for i, (panel, title) in enumerate(zip(panels, TITLES, strict=True)):
            at = i * (width + GAP)
            shown_part = panel.resize(size, Image.Resampling.LANCZOS).crop(box)
            sheet.paste(shown_part.resize((width, height), Image.Resampling.LANCZOS), (at, HEAD))
            draw.text((at + width / 2, HEAD / 2), title, INK, font, anchor="mm")
        yield sheet, 1 / fps


def _source(clip: Clip, frame: float) -> Image.Image:
    camera: Camera = camera_between(clip, frame)
    return Image.fromarray(source_frame(clip, frame, camera, channels=3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--clip", type=Path)
    parser.add_argument("--height", type=int, default=256, help="pixels of each of the three")
    parser.add_argument("--crop", default="0,0,1,1", help="left,top,right,bottom, fractions")
    parser.add_argument("--part", default="", help="first,last,step of the clip's frames")
    parser.add_argument("--quality", type=int, default=66, help="lowered until it fits")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    crop = tuple(float(edge) for edge in arguments.crop.split(","))
    part = tuple(int(number) for number in arguments.part.split(",") if number)
    made = list(frames(arguments.run, arguments.clip, arguments.height, crop, part))
    for quality in range(arguments.quality, 20, -8):
        made[0][0].save(
            arguments.out, save_all=True, append_images=[image for image, _ in made[1:]],
            duration=[round(1000 * seconds) for _, seconds in made], loop=0, quality=quality,
            method=6,
        )  # fmt: skip
        size = arguments.out.stat().st_size
        print(f"{arguments.out}: {len(made)} pictures, quality {quality}, {size / 1e6:.2f} MB")
        if size <= LARGEST:
            return
    raise SystemExit("too large for a README: lower --height")


if __name__ == "__main__":
    main()
