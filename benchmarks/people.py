"""Two people who cross, of whom each was clicked on: are they followed as themselves?

    python benchmarks/people.py --json benchmarks/results/people.json

The man of the recorded clip `juggle` walks from left to right through its background, before the
same man, later in the video, mirrored and with red, green and blue exchanged, who walks from right
to left. Both are cut out by the supplied mask without the ball, so that true masks are known but
for where the cut is not exact. `hoigs prepare` is run up to its estimators of people, once with
clicks in the first frame and once with clicks in different ones.

For each person: intersection over union with their true mask, mean over the frames that show at
least half of them (`median_area`), and the numbers of frames in which they are lost, and in which
their mask shows more of the other than of them.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image
from prepare_alone import evidence

from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import prepare_until, work_folder

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).resolve().parents[2] / "shared"))
COUNT, LATER, RATE = 72, 100, 24  # frames, frames between the two men, frames a second
WAYS = {"a": (260, 1000), "b": (1020, 250)}  # x of their middles, in the first and the last frame
CLICKS = {
    "clicks in the first frame": ("a=260,380@0", "b=1020,380@0"),
    "clicks in frames 71 and 24": ("a=1000,380@71", "b=760,380@24"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the results to this file")
    args = parser.parse_args()
    found = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        true = crossing(SHARED / "data" / "juggle", folder / "crossing.mp4")
        for number, (name, clicks) in enumerate(CLICKS.items()):
            found[name] = measure(folder, folder / f"clip{number}", clicks, true)
            print(name, json.dumps(found[name], indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


def crossing(source: Path, path: Path) -> dict[str, Bool[np.ndarray, "F H W"]]:
    """Writes the video; true masks by name."""
    with av.open(str(source / "video.mp4")) as container:
        frames = [
            frame.to_ndarray(format="rgb24")
            for frame, _ in zip(container.decode(video=0), range(COUNT + LATER), strict=False)
        ]
    men = [man(source, i) for i in range(len(frames))]
    seen = np.ma.array(frames[::8], mask=np.stack(men[::8])[..., None].repeat(3, -1))
    plate = np.ma.median(seen, axis=0).filled(60).astype(np.uint8)
    true: dict[str, list[np.ndarray]] = {"a": [], "b": []}
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=RATE, options={"crf": "18"})
        stream.height, stream.width = plate.shape[:2]
        stream.pix_fmt = "yuv420p"
        for i in range(COUNT):
            part = i / (COUNT - 1)
            a = moved(frames[i], men[i], WAYS["a"], part)
            other = frames[i + LATER][:, ::-1, [2, 0, 1]]
            b = moved(other, men[i + LATER][:, ::-1], WAYS["b"], part)
            image = plate.copy()
            for pixels, mask in (b, a):
                image[mask] = pixels[mask]
            true["a"].append(a[1])
            true["b"].append(b[1] & ~a[1])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return {name: np.stack(masks) for name, masks in true.items()}


def man(source: Path, frame: int) -> Bool[np.ndarray, "H W"]:
    """The supplied mask without the ball."""
    with Image.open(source / f"hoi_mask/{frame:05d}.png") as image:
        mask = np.asarray(image.convert("L")) > 127
    x, y, radius = np.load(source / "ball_track.npz")["xyr"][frame]
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    away = np.hypot(columns - x, rows - y)
    return mask & ~(away < 1.15 * radius)  # a ball that was not found is NaN


def moved(
    image: UInt8[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    way: tuple[int, int],
    part: float,
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """A man and his mask, shifted to a part of his way."""
    shift = round(way[0] + (way[1] - way[0]) * part - np.flatnonzero(mask.any(0)).mean())
    mask = np.roll(mask, shift, 1)
    mask[:, slice(0, shift) if shift > 0 else slice(shift or None, None)] = shift == 0
    return np.roll(image, shift, 1), mask


def measure(folder: Path, out: Path, clicks: tuple[str, ...], true: dict[str, Any]) -> Any:
    """Figures of both."""
    start = time.perf_counter()
    prepare_until(
        "estimates", folder / "crossing.mp4", out, person=clicks, object="none", yes=True,
        options=PrepareOptions(camera="static"),
    )  # fmt: skip
    seconds = round(time.perf_counter() - start, 1)
    raw = evidence(work_folder(out))
    assert raw.masks.human is not None
    masks = {"a": raw.masks.human, "b": raw.further["b"]}
    rows: dict[str, Any] = {"seconds": seconds}
    for name, stack in masks.items():
        own, other = true[name], true["b" if name == "a" else "a"]
        found = np.stack(list(stack))
        union = (found | own).sum((1, 2))
        iou = (found & own).sum((1, 2)) / np.maximum(union, 1)
        areas = own.sum((1, 2))
        shown = areas > 0.5 * np.median(areas)
        wrong = (found & other).sum((1, 2)) > (found & own).sum((1, 2))
        rows[name] = {
            "iou": round(float(iou[shown].mean()), 3),
            "iou_worst": round(float(iou[shown].min()), 3),
            "frames": int(shown.sum()),
            "lost": int((~found[shown].any((1, 2))).sum()),
            "the_other": int(wrong.sum()),
        }
    return rows


if __name__ == "__main__":
    main()
