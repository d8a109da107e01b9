"""write_page: a run as one HTML file with a player, thinned to a size where one is given."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.maths.rotations import (
    kabsch,
    matrices_to_quats,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.files import write_whole
from hoigs.core.values.gaussians import Gaussians
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.viewer.run_drawing import RunDrawing
from hoigs.viewing.viewer.takes import distance_to_subject

# Tracks: the entities of a run over time, sorted by how they move, and quantised.

STILL_M = 5e-4  # an entity whose Gaussians all stay within this is stored once
RIGID_M = 2e-3  # percentile 99 of what may be left of a motion that is stored as poses
STEADY = 0.02  # change of colour, opacity and logarithm of scales of an entity that is stored once
Motion = Literal["static", "rigid", "moving"]


@dataclass(frozen=True)
class Track:
    """One entity over K keys (times); static and rigid ones have one key of Gaussians.

    Attributes:
        means: metres. quats: wxyz, unit, of the nearer sign from key to key. log_scales: of metres.
        rgba: colour, which may be brighter than 1 where a Gaussian is transparent, and opacity.
        poses: of a rigid one, quaternion and translation in every key.
    """

    name: str
    motion: Motion
    means: Float[Tensor, "K N 3"]
    quats: Float[Tensor, "K N 4"]
    log_scales: Float[Tensor, "K N 3"]
    rgba: Float[Tensor, "K N 4"]
    poses: Float[Tensor, "F 7"] | None = None

    def __len__(self) -> int:
        return self.means.shape[1]

    def importance(self) -> Float[Tensor, " N"]:
        """Largest opacity over time times the area of the two longest axes, square metres."""
        two = self.log_scales.sort(-1).values[..., 1:].sum(-1)
        return (self.rgba[..., 3] * two.exp()).amax(0)

    def only(self, rows: Tensor) -> Track:
        """These Gaussians."""
        return replace(
            self, means=self.means[:, rows], quats=self.quats[:, rows],
            log_scales=self.log_scales[:, rows], rgba=self.rgba[:, rows],
        )  # fmt: skip

    def every(self, stride: int) -> Track:
        """Every stride-th key, and the last, of a moving entity; the others are not changed."""
        keys = len(self.means)
        if self.motion != "moving" or stride == 1:
            return self
        kept = key_frames(keys, stride)
        return replace(
            self, means=self.means[kept], quats=self.quats[kept],
            log_scales=self.log_scales[kept], rgba=self.rgba[kept],
        )  # fmt: skip


def key_frames(frames: int, stride: int) -> list[int]:
    """Every stride-th frame, and the last."""
    return sorted({*range(0, frames, stride), frames - 1})


def track_of(
    name: str,
    frames: Sequence[Gaussians],
    eyes: Sequence[Float[Tensor, " 3"]],
    rigid: bool = True,
) -> Track:
    """The track of an entity from its Gaussians in every frame.

    Args:
        eyes: camera centres, world; colours are the mean of what they see, as a track stores none
            that depends on the direction. rigid: whether poses may stand for the motion.
    """
    means = torch.stack([g.means for g in frames])
    quats = _continuous(torch.stack([normalize_quats(g.quats) for g in frames]))
    scales = torch.stack([g.log_scales for g in frames])
    rgba = torch.stack([rgba_of(g, eyes) for g in frames])
    whole = Track(name, "moving", means, quats, scales, rgba)
    if not len(whole):
        return whole
    own = torch.stack([g.colors for g in frames])  # what the light changes, not the direction
    if any(float((x - x[:1]).abs().max()) >= STEADY for x in (scales, rgba[..., 3], own)):
        return whole
    middle = len(frames) // 2
    one = replace(
        whole, motion="static", means=means[:1], quats=quats[:1], log_scales=scales[:1],
        rgba=rgba[middle : middle + 1],
    )  # fmt: skip
    if float((means - means[:1]).norm(dim=-1).max()) < STILL_M:
        return one
    if not rigid or len(whole) < 3:
        return whole
    poses = torch.stack([pose_of(means[0], m) for m in means])
    left = [remaining(means[0], quats[0], m, q, p) for m, q, p in zip(means, quats, poses)]
    if max(left) > RIGID_M:
        return whole
    return replace(one, motion="rigid", poses=poses)


def rgba_of(gaussians: Gaussians, eyes: Sequence[Float[Tensor, " 3"]]) -> Float[Tensor, "N 4"]:
    """Colour, the mean of what these camera centres see, and opacity."""
    color = mean_colors(gaussians.sh, gaussians.means, eyes)
    return torch.cat((color, gaussians.opacities[:, None]), -1)


def _continuous(quats: Float[Tensor, "K N 4"]) -> Float[Tensor, "K N 4"]:
    """The same rotations, with the sign nearer to that of the key before."""
    signs = torch.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)
    signs = torch.cat((torch.ones_like(quats[:1, :, 0]), signs)).cumprod(0)
    return quats * signs[..., None]


def pose_of(source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"]) -> Float[Tensor, " 7"]:
    """Rotation (quaternion) and translation that take the source to the target."""
    rotation = kabsch(source.double(), target.double())
    shift = target.double().mean(0) - rotation @ source.double().mean(0)
    return torch.cat((matrices_to_quats(rotation), shift)).float()


def remaining(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    moved: Float[Tensor, "N 3"],
    turned: Float[Tensor, "N 4"],
    pose: Float[Tensor, " 7"],
) -> float:
    """Percentile 99 of the distance between a rigid motion and the true one, metres.

    A rotation that differs by more than 2 degrees counts as 1 m.
    """
    rotated = means @ quats_to_matrices(pose[:4]).mT + pose[4:]
    apart = (rotated - moved).norm(dim=-1)
    dot = (multiply_quats(pose[:4].expand_as(quats), quats) * turned).sum(-1).abs()
    worst = float(torch.quantile(apart[:: len(apart) // 100_000 + 1], 0.99))
    return worst if float(dot.median()) > 0.99985 else 1.0


# Packing: tracks as bytes, 17 a Gaussian and key before compression.
#
# Positions take 16 bits an axis within the box of the entity over time, logarithms of scales 8 bits
# within their range, quaternions, colour and opacity 8 bits a number, colours as a share of the
# brightest: transparent Gaussians may be brighter than white. Of every key but the first only the
# difference to the key before is stored, and all first bytes come before all second ones, which
# gzip likes.


def packed(tracks: Sequence[Track]) -> tuple[list[dict[str, Any]], bytes]:
    """A description of every track, and the compressed bytes of all."""
    heads, parts = [], []
    for track in tracks:
        head, data = _track(track)
        heads.append(head)
        parts.append(data)
    return heads, gzip.compress(b"".join(parts), 6, mtime=0)


def _track(track: Track) -> tuple[dict[str, Any], bytes]:
    low, high = _span(track.means)
    small, large = _span(track.log_scales)
    means = _codes(track.means, low, high, 65535)
    scales = _codes(track.log_scales, small, large, 255)
    quats = (track.quats.clamp(-1, 1) * 127).round().to(torch.int64)
    bright = _brightest(track.rgba[..., :3])
    color = torch.cat((track.rgba[..., :3] / bright, track.rgba[..., 3:]), -1)
    rgba = (color.clamp(0, 1) * 255).round().to(torch.int64)
    steps = _steps(means, 65536)
    data = b"".join(
        part.astype(np.uint8).tobytes()
        for part in (steps & 255, steps >> 8, *(_steps(x, 256) for x in (scales, quats, rgba)))
    )
    head = {
        "name": track.name, "motion": track.motion, "count": len(track), "keys": len(track.means),
        "low": low.tolist(), "high": high.tolist(), "small": small.tolist(),
        "large": large.tolist(), "bright": bright, "bytes": len(data),
        "poses": None if track.poses is None else np.round(track.poses.numpy(), 6).tolist(),
    }  # fmt: skip
    return head, data


def _brightest(colors: Float[Tensor, "K N 3"]) -> float:
    """The colour that is stored as 255: 1, or what one in a thousand surpasses."""
    flat = colors.flatten()
    if not len(flat):
        return 1.0
    some = flat[:: len(flat) // 1_000_000 + 1]  # as many as torch sorts
    return max(1.0, float(torch.quantile(some, 0.999)))


def _span(values: Float[Tensor, "K N 3"]) -> tuple[Tensor, Tensor]:
    flat = values.flatten(0, 1).double()
    if not len(flat):
        return torch.zeros(3), torch.ones(3)
    return flat.amin(0), torch.maximum(flat.amax(0), flat.amin(0) + 1e-6)


def _codes(values: Float[Tensor, "K N 3"], low: Tensor, high: Tensor, top: int) -> Tensor:
    return ((values.double() - low) / (high - low) * top).round().to(torch.int64)


def _steps(codes: Tensor, modulus: int) -> np.ndarray:
    """Differences from key to key, channel by channel, modulo the range of a code."""
    array = codes.permute(0, 2, 1).numpy()  # [K, C, N]: equal channels lie together
    array = np.concatenate((array[:1], np.diff(array, axis=0)))
    result: np.ndarray = np.mod(array, modulus)
    return result


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
    folder = files("hoigs.viewing.player")
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
