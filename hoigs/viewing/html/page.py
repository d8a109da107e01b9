"""write_page: a run as one HTML file with a player, thinned to a size where one is given."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.files.whole_files import write_whole
from hoigs.core.progress import Progress, no_progress
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.html.packing import packed
from hoigs.viewing.html.tracks import Track, track_of
from hoigs.viewing.viewer.pictures.run_drawing import RunDrawing
from hoigs.viewing.viewer.takes import distance_to_subject

EYES = 8  # cameras whose views of a colour are averaged
STRIDES = (1, 2, 4)  # of moving entities, tried before Gaussians are dropped
_ORDINAL = {2: "second", 4: "fourth"}
FEWEST = 0.02  # share of the Gaussians below which a size is refused
SEARCHES = 3  # tries to find the share of Gaussians that is kept
Made = tuple[list[Track], list[dict[str, Any]], bytes]  # tracks, and as they are packed


@dataclass(frozen=True)
class Page:
    """A page that was written.

    Attributes:
        gaussians, of: stored, and in the run. stride: frames from key to key of what moves.
        left_out: sentences on what the file does not have.
    """

    path: Path
    megabytes: float
    gaussians: int
    of: int
    stride: int
    left_out: Sequence[str]

    def __str__(self) -> str:
        return f"{self.path}: {self.megabytes:.1f} MB. " + " ".join(self.left_out)


def write_page(
    loaded: LoadedRun,
    path: Path | str,
    *,
    max_mb: float | None = None,
    entities: Sequence[str] = (),
    progress: Progress | None = None,
) -> Page:
    """Write a run to one HTML file that needs neither a server nor a network.

    Args:
        max_mb: of the file, in units of 10^6 bytes: first fewer frames of what moves are stored,
            then the Gaussians that cover least are left out. None stores all.
        entities: names; all by default.

    Raises:
        HoigsError: an entity is unknown, the size cannot be reached, or the disk is full.
    """
    path, report = Path(path), progress or no_progress
    if path.suffix.lower() not in (".html", ".htm"):
        raise HoigsError(f"{path}: expected a name that ends in .html")
    tracks = collect(loaded, entities, report)
    budget = None if max_mb is None else int(max_mb * 1e6)
    kept, stride, text = _fitting(loaded, tracks, budget, report)
    total = sum(len(t) for t in tracks)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
    except OSError as error:
        raise HoigsError(f"{path} cannot be written: {error.strerror or error}") from error
    left = _left_out(loaded, tracks, kept, stride)
    count = sum(len(t) for t in kept)
    return Page(path, path.stat().st_size / 1e6, count, total, stride, left)


@torch.no_grad()
def collect(loaded: LoadedRun, entities: Sequence[str], report: Progress) -> list[Track]:
    """The track of every entity, from all frames of the clip."""
    drawing, clip = RunDrawing(loaded), loaded.clip
    for name in entities:
        if name not in drawing.names:
            near = did_you_mean(name, drawing.names)
            raise HoigsError(f"--entities {name}: this run has {', '.join(drawing.names)}{near}")
    chosen = [name for name in drawing.names if not entities or name in entities]
    rows = drawing.rows()
    every = max(1, len(clip) // EYES)
    eyes = [camera.center for camera in clip.cameras[::every]]
    frames: dict[str, list[Any]] = {name: [] for name in chosen}
    for i in range(clip.num_frames):
        report(0.6 * i / clip.num_frames, "moving the Gaussians")
        everything = drawing.gaussians(float(i)).to("cpu")
        for name in chosen:
            frames[name].append(everything[rows[name]].clone())
    return [track_of(name, frames[name], eyes) for name in chosen]


def _fitting(
    loaded: LoadedRun, tracks: Sequence[Track], budget: int | None, report: Progress
) -> tuple[list[Track], int, str]:
    """Tracks, stride and page of the fullest file within the budget."""
    shell = len(_page(loaded, [], b"", [], 1))

    def attempt(share: float, stride: int) -> Made:
        thinned = [_thinned(t, share).every(stride) for t in tracks]
        return thinned, *packed(thinned)

    def size(made: Made) -> int:
        return shell + len(json.dumps(made[1])) + 4 * (len(made[2]) + 2) // 3 + 1000

    share, stride = 1.0, 1
    made = attempt(share, stride)
    if budget is not None and size(made) > budget:
        for stride in STRIDES[1:]:
            report(0.7, f"every {_ORDINAL[stride]} frame")
            made = attempt(share, stride)
            if size(made) <= budget:
                break
        else:
            made = _fewer(partial(attempt, stride=stride), size, made, budget, report)
    thinned, heads, data = made
    text = _page(loaded, heads, data, _left_out(loaded, tracks, thinned, stride), stride)
    return thinned, stride, text


def _fewer(
    attempt: Callable[[float], Made],
    size: Callable[[Made], int],
    whole: Made,
    budget: int,
    report: Progress,
) -> Made:
    """The fullest attempt within the budget that few tries find: a size is nearly linear in the
    share of the Gaussians.

    Raises:
        HoigsError: even the fewest are too large.
    """
    low, best = FEWEST, attempt(FEWEST)
    least = size(best)
    if least > budget:
        raise HoigsError(
            f"--max-mb {budget / 1e6:g}: with {100 * FEWEST:.0f} % of the Gaussians the file still "
            f"has {least / 1e6:.2f} MB; allow more, or give fewer --entities"
        )
    high, most = 1.0, size(whole)
    for i in range(SEARCHES):
        share = low + (high - low) * 0.99 * (budget - least) / (most - least)
        report(0.8 + 0.05 * i, f"{100 * share:.0f} % of the Gaussians")
        made = attempt(share)
        if size(made) <= budget:
            low, least, best = share, size(made), made
        else:
            high, most = share, size(made)
    return best


def _thinned(track: Track, share: float) -> Track:
    """The Gaussians that cover most."""
    if share >= 1.0 or not len(track):
        return track
    count = max(1, round(share * len(track)))
    rows = track.importance().topk(count).indices.sort().values
    return track.only(rows)


def _left_out(
    loaded: LoadedRun, tracks: Sequence[Track], kept: Sequence[Track], stride: int
) -> list[str]:
    """Sentences on what the page has not."""
    total, count = sum(map(len, tracks)), sum(map(len, kept))
    sentences = ["Colours do not change with the direction (the mean over the video's cameras)."]
    if count < total:
        sentences.append(
            f"{count:,} of {total:,} Gaussians ({100 * count / total:.0f} %), those that cover "
            "most: the others are left out."
        )
    else:
        sentences.append(f"All {total:,} Gaussians.")
    if stride > 1 and any(t.motion == "moving" for t in kept):
        sentences.append(
            f"Of what moves every {_ORDINAL[stride]} frame: between them it is interpolated."
        )
    missing = [n for n in loaded.model.entities if n not in {t.name for t in kept}]
    if missing:
        sentences.append(f"Without {', '.join(missing)}.")
    return sentences


def _page(
    loaded: LoadedRun,
    heads: Sequence[dict[str, Any]],
    data: bytes,
    left_out: Sequence[str],
    stride: int,
) -> str:
    """The text of the file."""
    clip = loaded.clip
    header = {
        "title": f"{loaded.spec.name} on {clip.name}",
        "frames": clip.num_frames,
        "fps": clip.fps,
        "stride": stride,
        "tracks": list(heads),
        "lowPass": loaded.model.low_pass,
        "antialiased": loaded.model.antialiased,
        "up": clip.up().tolist(),
        "distance": distance_to_subject(clip),
        "cameras": [
            {
                "frame": moment.index,
                "pose": [round(float(x), 6) for x in camera.world_to_camera[:3].flatten()],
                "K": [float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
                "size": [camera.width, camera.height],
            }
            for moment, camera in zip(clip.moments, clip.cameras, strict=True)
        ],
        "leftOut": list(left_out),
    }
    folder = files("hoigs.viewing.html")
    text = folder.joinpath("player.html").read_text(encoding="utf-8")
    parts = {
        "/*STYLE*/": folder.joinpath("player.css").read_text(encoding="utf-8"),
        "/*HEADER*/": json.dumps(header).replace("<", "\\u003c"),
        "/*DATA*/": base64.b64encode(data).decode("ascii"),
        "/*SCRIPT*/": folder.joinpath("player.js").read_text(encoding="utf-8"),
    }
    for mark, part in parts.items():
        text = text.replace(mark, part)
    return text
