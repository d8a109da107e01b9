"""Masks of estimator:object-tracker against known ones: IoU over frames, and seconds.

    python benchmarks/object_tracking.py builtin:lift-and-swing builtin:throw-and-catch
    python benchmarks/object_tracking.py videos/juggle --object 652,324@0

A built-in clip is rendered and its object clicked in its middle in frame 0, with the true masks of
its person and with rough ones (their rim moved in and out, as a segmenter's is). A folder holds
video.mp4, hoi_mask/*.png (person and object together) and, to tell the two apart, ball_track.npz
(x, y, radius); without one, the union of the object's and the person's masks is compared. Without
--object the object is proposed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import av
import numpy as np
from PIL import Image
from scipy import ndimage

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    Estimates,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.estimator import ObjectTrackerEstimator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", nargs="+", help="builtin:NAME, or a folder")
    parser.add_argument("--object", help="x,y@frame of a click in a folder's video")
    parser.add_argument(
        "--person", type=Path, help=".npz with `person` [F, H, W] in place of truth"
    )
    parser.add_argument("--sheet", type=Path, help="folder for pictures of the masks")
    args = parser.parse_args()
    print("| clip | person's masks | object | IoU mean | worst 5 % | not seen | seconds |")
    print("|---|---|---|---|---|---|---|")
    for clip in args.clips:
        if clip.startswith("builtin:"):
            frames, person, truth = builtin(clip)
            for kind, masks in (("true", person), ("rough", rough(person))):
                for prompt in (click_on(truth[0]), None):
                    report(clip, frames, kind, masks, prompt, truth, args.sheet)
        else:
            frames, person, truth, together = folder(Path(clip))
            kind = "true"
            if args.person is not None:
                person, kind = list(np.load(args.person)["person"]), "given"
            prompt = None if args.object is None else parsed(args.object)
            report(clip, frames, kind, person, prompt, truth, args.sheet, together)


def builtin(name: str):
    """Frames and true masks of a built-in clip."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.runs.clip_source import read_clip
    from hoigs.synthesis.named import named_clip

    clip = read_clip(named_clip(name, AnnyBody()))
    every = [clip[i] for i in range(len(clip))]
    masks = {n: [f.masks[n].numpy() for f in every] for n in ("human", "object")}
    return [f.image.numpy() for f in every], masks["human"], masks["object"]


def folder(path: Path):
    """Frames, masks of the person (or None), of the object, and whether these are of both."""
    with av.open(str(path / "video.mp4")) as video:
        frames = [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
    both = [np.asarray(Image.open(p).convert("L")) > 127 for p in sorted(path.glob("hoi_mask/*"))]
    if not (path / "ball_track.npz").is_file():
        return frames, None, both, True
    y, x = np.mgrid[: frames[0].shape[0], : frames[0].shape[1]] + 0.5
    track = np.load(path / "ball_track.npz")["xyr"]
    ball = [np.hypot(x - cx, y - cy) <= r for cx, cy, r in track]
    known = np.isfinite(track).all(1)
    person = [b & ~o for b, o in zip(both, ball, strict=True)]
    return frames, person, [o if k else None for o, k in zip(ball, known, strict=True)], False


def rough(masks: list[np.ndarray]) -> list[np.ndarray]:
    """Masks whose rim wanders by about 1 % of the width, differently in each frame."""
    rng = np.random.default_rng(0)
    unit = 0.01 * masks[0].shape[1]
    found = []
    for mask in masks:
        inner = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
        wander = ndimage.gaussian_filter(rng.normal(size=mask.shape), 4 * unit)
        found.append(inner + 1.5 * unit * wander / wander.std() > 0)
    return found


def click_on(mask: np.ndarray) -> tuple[float, float, int]:
    """The innermost pixel of a mask, in frame 0."""
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    y, x = np.unravel_index(depth.argmax(), depth.shape)
    return float(x), float(y), 0


def parsed(text: str) -> tuple[float, float, int]:
    place, _, frame = text.partition("@")
    x, y = place.split(",")
    return float(x), float(y), int(frame or 0)


def report(name, frames, kind, person, prompt, truth, sheet, together=False) -> None:
    """One row of the table, and a picture."""
    with tempfile.TemporaryDirectory() as work:
        points = () if prompt is None else (PromptPoint(prompt[0], prompt[1]),)
        known = None if person is None else Estimates(EntityMasks({"human": person}))
        video = VideoRequest(
            len(frames), frames[0].shape[1], frames[0].shape[0], lambda i: frames[i], Path(work),
            Path(work), entities=(EntityRequest("object", "object", points=points,
            frame=prompt[2] if prompt else 0),), known=known,
        )  # fmt: skip
        start = time.process_time()
        found = ObjectTrackerEstimator().estimate(video).masks
        spent = time.process_time() - start
        assert found is not None
        masks = [found.entities["object"][i] for i in range(len(frames))]
    scores, unseen = [], sum(not m.any() for m in masks)
    for i, (mask, true) in enumerate(zip(masks, truth, strict=True)):
        if true is not None:
            ours = mask | person[i] if together and person is not None else mask
            scores.append((ours & true).sum() / max((ours | true).sum(), 1) if true.any() else 1.0)
    ordered = np.sort(scores)
    worst = ordered[: max(1, len(ordered) // 20)].mean()
    where = "proposed" if prompt is None else f"{prompt[0]:g},{prompt[1]:g}@{prompt[2]}"
    print(
        f"| {name} | {kind if person is not None else 'none'} | {where} | {ordered.mean():.3f} "
        f"| {worst:.3f} | {unseen} of {len(frames)} | {spent:.0f} |", flush=True,
    )  # fmt: skip
    for note in found.notes:
        print(f"  {note}", flush=True)
    if sheet is not None:
        draw(frames, masks, sheet / f"{Path(name).name.replace(':', '-')}-{kind}-{where}.png")


def draw(frames, masks, path: Path) -> None:
    """Eighteen frames with the mask in red."""
    tiles = []
    for i in np.linspace(0, len(frames) - 1, 18).astype(int):
        image = frames[i].copy()
        image[masks[i]] = image[masks[i]] // 2 + np.uint8([125, 0, 0])
        tile = Image.fromarray(image)
        tiles.append(np.asarray(tile.resize((300, 300 * tile.height // tile.width))))
    rows = [np.concatenate(tiles[k : k + 6], 1) for k in range(0, 18, 6)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


if __name__ == "__main__":
    main()
