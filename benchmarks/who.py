"""Is a small person found without a click, and nobody where there is none?

    python benchmarks/who.py --json benchmarks/results/who.json

The man of the recorded clip `juggle`, cut out by the supplied mask without the ball and made
smaller, walks through his own background beside a blue post that is twice as tall; or nobody does;
or hands alone lay letter blocks (the recorded clip `blocks`). `hoigs prepare` is run up to its
estimators of people, with nothing given. For each share of the picture's height: frames with
landmarks, and intersection over union with the true mask, mean and worst; or the error that says
nobody is there.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Bool, UInt8
from people import SHARED, man
from PIL import Image
from prepare_alone import evidence

from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import prepare_until, work_folder
from hoigs.preparation.video.source import NobodyFoundError

COUNT, RATE, SHARES = 48, 24, (0.29, 0.2, 0.0)
TALL, POST = 0.86, (slice(260, 660), slice(880, 990))  # of the recorded man; rows and columns
BESIDE = 330  # pixels: as far beside the man the background is copied from


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the results to this file")
    args = parser.parse_args()
    found: dict[str, Any] = {}
    frames = read(SHARED / "data/juggle/video.mp4")
    men = np.stack([man(SHARED / "data/juggle", i) for i in range(COUNT)])
    plate = background(frames, men)
    with tempfile.TemporaryDirectory() as temporary:
        for share in SHARES:
            path = Path(temporary) / f"{share}.mp4"
            true = composed(path, frames, men, plate, share)
            found[f"{100 * share:.0f} % of the height" if share else "nobody"] = measure(path, true)
        path = Path(temporary) / "blocks.mp4"
        write(path, read(SHARED / "data/blocks/video.mp4", 40))
        found["hands"] = measure(path, None)
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


def read(path: Path, first: int = 0) -> UInt8[np.ndarray, "F H W 3"]:
    with av.open(str(path)) as container:
        decoded = zip(container.decode(video=0), range(first + COUNT), strict=False)
        return np.stack([f.to_ndarray(format="rgb24") for f, i in decoded if i >= first])


def write(path: Path, frames: UInt8[np.ndarray, "F H W 3"]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=RATE, options={"crf": "18"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def background(
    frames: UInt8[np.ndarray, "F H W 3"], men: Bool[np.ndarray, "F H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """The first frame; where anybody ever is, what is beside."""
    hidden = np.zeros_like(men[0])
    hidden[:, men.any((0, 1))] = True
    return np.where(hidden[..., None], np.roll(frames[0], BESIDE, 1), frames[0])


def composed(
    path: Path, frames: np.ndarray, men: np.ndarray, plate: np.ndarray, share: float
) -> Bool[np.ndarray, "F H W"]:
    """Writes the video; true masks."""
    height, width = plate.shape[:2]
    shown, true = np.stack([plate] * len(frames)), np.zeros_like(men)
    across = np.sqrt(1 - 0.9 * np.linspace(-1, 1, POST[1].stop - POST[1].start) ** 2)
    shown[:, POST[0], POST[1]] = (np.array((30, 60, 200)) * (0.55 + 0.45 * across)[:, None]).astype(
        int
    )
    size = (round(width * share / TALL), round(height * share / TALL))
    for i in range(len(frames)) if share else ():
        small = np.asarray(Image.fromarray(frames[i]).resize(size, Image.Resampling.LANCZOS))
        soft = Image.fromarray(np.uint8(men[i]) * 255).resize(size, Image.Resampling.BOX)
        alpha = np.asarray(soft)[..., None] / 255
        top, left = round(0.9 * height) - size[1], round(380 + 1.5 * i - 0.55 * size[0])
        part = (i, slice(top, top + size[1]), slice(left, left + size[0]))
        shown[part] = (shown[part] * (1 - alpha) + small * alpha).astype(np.uint8)
        true[part] = alpha[..., 0] > 0.5
    write(path, shown)
    return true


def measure(path: Path, true: Bool[np.ndarray, "F H W"] | None) -> dict[str, Any]:
    """Figures of one video, or why nobody is found."""
    out = path.with_suffix("")
    try:
        prepare_until(
            "estimates", path, out, object="none", yes=True, options=PrepareOptions(camera="static")
        )
    except NobodyFoundError as error:
        return {"nobody": str(error)}
    raw = evidence(work_folder(out))
    assert raw.masks.human is not None and raw.person is not None and true is not None
    found = np.stack(list(raw.masks.human))
    iou = (found & true).sum((1, 2)) / np.maximum((found | true).sum((1, 2)), 1)
    return {
        "landmarks": int(raw.person.found.sum()), "frames": len(found),
        "iou": round(float(iou.mean()), 3), "iou_worst": round(float(iou.min()), 3),
    }  # fmt: skip


if __name__ == "__main__":
    main()
