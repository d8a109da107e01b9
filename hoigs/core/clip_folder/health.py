"""Defects of a readable clip with which training can continue, as diagnostics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.maths.rotations import axis_angle_to_quats, turn_between
from hoigs.core.reporting import Diagnostic, ranges
from hoigs.core.values.camera import pinhole_pixels
from hoigs.core.values.clip import Clip

# What no camera of a clip shows: its scene points, a person or an object.

MOST_POINTS = 20_000  # of the scene, looked at
BODY_REACH = 2.0  # metres from a body's root, within which all of it lies
LEAST_REACH = 0.05  # of an object from its centre, metres
LEAST_PIXELS = 0.5  # of that reach in a picture; what is smaller shows nothing
DO = (
    "check that the cameras have world_to_camera (not camera_to_world) in metres, x right, y down, "
    "z forward, and that {} lies in the same world; nothing is learned of it"
)


def unseen(clip: Clip) -> Iterator[Diagnostic]:
    """A diagnostic of severity "bad" for each of scene, people and objects that no camera sees."""
    points = clip.points[:: max(1, len(clip.points) // MOST_POINTS)]
    if len(points) and not any(c.shows(*c.project(points)).any() for c in clip.cameras):
        middle = clip.cameras[0].to_camera(points).median(0).values
        yield _fault("the scene", "none of its points lies in a picture", middle)
    tracks = {name: (body.poses.transl, BODY_REACH) for name, body in clip.bodies.items()}
    for name, track in clip.objects.items():
        reach = track.points.norm(dim=-1).amax() if len(track.points) else 0.0
        tracks[name] = (track.translations, max(float(reach), LEAST_REACH))
    for name, (path, reach) in tracks.items():
        places = torch.stack([c.to_camera(x) for c, x in zip(clip.cameras, path, strict=True)])
        if not _in_sight(clip, places, reach):
            yield _fault(
                f'"{name}"', "it is too far off to be seen, or outside of all pictures", places[0]
            )


def _in_sight(clip: Clip, places: Float[Tensor, "F 3"], reach: float) -> bool:
    """Whether a ball lies at least partly in the picture of any frame.

    Args:
        places: its centre in the coordinates of each frame's camera, metres.
        reach: its radius, metres.
    """
    K = torch.stack([c.K for c in clip.cameras])
    size = torch.tensor([[c.width, c.height] for c in clip.cameras])
    radius = K[:, 0, 0] * reach / places[:, 2].clamp_min(1e-6)
    pixels, about = pinhole_pixels(K, places, near=1e-6), radius[:, None]
    overlaps = ((pixels > -about) & (pixels < size + about)).all(-1)
    seen = overlaps & (places[:, 2] > 0) & (radius > LEAST_PIXELS)
    return bool((seen | (places.norm(dim=-1) < reach)).any())


def _fault(who: str, what: str, place: Float[Tensor, " 3"]) -> Diagnostic:
    x, y, z = place.tolist()
    return Diagnostic(
        "unseen",
        f"no camera sees {who}: {what}; in the first frame it is at "
        f"x {x:,.4g}, y {y:,.4g}, z {z:,.4g} m of the camera",
        DO.format(who),
        severity="bad",
    )


MOST_FRAMES = 600  # examined in long clips, evenly spaced: each takes milliseconds to decode
DEPTH_FRAMES, DEPTH_POINTS = 12, 20_000
NO_GAP = 1.1  # times as far, up to which what moves speaks against a gap
STEADY = 12  # median deviations of a track's steps beyond which it shows a gap by itself
LEAST_AREA = 200  # pixels of a mask: a smaller one is mostly edge, whether it is ragged or not
LEAST_POSES = 12  # of fewer, a fast motion cannot be told from noise
FULL, RAGGED, JITTER_DEGREES, UNLIKE, HOLES, GAP = 0.98, 0.12, 1.5, 0.07, 0.3, 1.6


def examine(clip: Clip) -> list[Diagnostic]:
    """Diagnostics of the clip's reader, then those of the clip's content.

    Looks at masks of up to 600 frames, depth of a dozen, and all poses, cameras and tracks.
    """
    found = list(clip.faults)
    with ThreadPoolExecutor(4) as pool:  # decompression releases the interpreter lock
        for name in clip.kinds:
            found += _masks(clip, name, pool)
    found += _depth(clip)
    for name, body in clip.bodies.items():
        found += _jitter(name, body.poses.rotations[:, :22])
    return [*found, *_gaps(clip), *unseen(clip)]


def require_useful(clip: Clip, found: Sequence[Diagnostic]) -> None:
    """Raise ClipError when a diagnostic is "bad": training would learn nothing of something."""
    if bad := [f"  {fault}" for fault in found if fault.severity == "bad"]:
        bad.append("or train all the same: --allow-faults (docs/reference/clip.md)")
        raise ClipError(f"clip {clip.name} cannot be trained on:\n" + "\n".join(bad))


def raggedness(mask: Bool[Tensor, "H W"]) -> float:
    """Share of the pixels within 2 px of a mask's smoothed edge that disagree with their
    surroundings (the majority of 5x5): fingers give a few per cent, noise its own share."""
    from kornia.morphology import gradient

    area = mask.nonzero()
    if len(area) == 0:
        return 0.0
    (top, left), (bottom, right) = (area.amin(0) - 6).clamp_min(0), area.amax(0) + 7
    x = mask[top:bottom, left:right].float()[None, None]
    mean = torch.nn.functional.avg_pool2d(x, 5, 1, 2, count_include_pad=False)
    smooth = (mean > 0.5).float()
    band = gradient(smooth, torch.ones(5, 5), engine="shift") > 0.5
    return float(((x != smooth) & band).sum() / band.sum().clamp_min(1))


def _masks(clip: Clip, name: str, pool: ThreadPoolExecutor) -> Iterator[Diagnostic]:
    step = -(-len(clip) // MOST_FRAMES)
    positions = [p for p in range(0, len(clip), step) if clip.store.mask_known(name, p)]

    def look(position: int) -> tuple[float, float | None]:
        mask = clip.store.mask(name, position)
        rough = raggedness(mask) if int(mask.sum()) >= LEAST_AREA else None
        return float(mask.float().mean()), rough

    seen = list(pool.map(look, positions))
    number = {p: clip.moments[p].index for p in positions}
    empty = [number[p] for p, (area, _) in zip(positions, seen) if area == 0]
    full = [number[p] for p, (area, _) in zip(positions, seen) if area > FULL]
    edges = sorted(rough for area, rough in seen if area <= FULL and rough is not None)
    if empty:
        yield Diagnostic(
            "empty-masks",
            f'masks of "{name}" are empty in frames {ranges(empty)} '
            f"({len(empty)} of {len(positions)})",
            "right where it is out of sight; make them again where it is not: it is not compared "
            "with the video there",
            tuple(empty),
        )
    if full:
        yield Diagnostic(
            "full-masks",
            f'masks of "{name}" cover the whole image in frames {ranges(full)}',
            "make them again, or delete them and train with --allow-faults: as they are, all that "
            "is seen there is taken for it",
            tuple(full),
        )
    if edges and edges[len(edges) // 2] > RAGGED:
        yield Diagnostic(
            "ragged-masks",
            f'masks of "{name}" have ragged edges: {100 * edges[len(edges) // 2]:.0f} % of the '
            "pixels within 2 px of them disagree with their surroundings",
            "smooth them (a median of 5x5 takes single pixels away), or use a segmenter that "
            "follows edges",
        )


def _depth(clip: Clip) -> Iterator[Diagnostic]:
    if clip.depth_kind == "none":
        return
    maps = [d for p in _depth_frames(clip) if (d := clip.store.depth(p)) is not None]
    holes = [float((depth <= 0).float().mean()) for depth in maps]
    if holes and sum(holes) / len(holes) > HOLES:
        yield Diagnostic(
            "depth-holes",
            f"{100 * sum(holes) / len(holes):.0f} % of the depth maps' pixels are unknown",
            "nothing is learned from depth there; it is right for sparse sensors, else make depth "
            "again",
        )
    factor = depth_factor(clip)
    if factor != 1:
        yield Diagnostic(
            "depth-scale",
            f"the depth maps are {factor:.2f} times as deep as the scene points",
            f"multiply them by {1 / factor:.2f}; the depth loss does so meanwhile "
            "(train.loss.depth_fit=auto), but scores and what is placed by depth do not",
        )


def _depth_frames(clip: Clip) -> range:
    return range(0, len(clip), max(1, len(clip) // DEPTH_FRAMES))


def depth_factor(clip: Clip) -> float:
    """How many times as deep as the scene points metric depth maps are; 1 where that is not known,
    or so little off that the points' own spread may be to blame."""
    if clip.depth_kind != "metric":
        return 1.0
    points = clip.points[:: max(1, len(clip.points) // DEPTH_POINTS)]
    ratios = [
        _against_points(clip, p, depth, points)
        for p in _depth_frames(clip)
        if (depth := clip.store.depth(p)) is not None
    ]
    factor = _agreed(torch.cat(ratios)) if ratios else None
    return factor if factor is not None and abs(factor - 1) > UNLIKE else 1.0


def _against_points(
    clip: Clip, position: int, depth: Float[Tensor, "H W"], points: Float[Tensor, "P 3"]
) -> Float[Tensor, " R"]:
    """Depth over the points' own, where these fall on nothing that moves."""
    camera = clip.cameras[position]
    pixels, z = camera.project(points)
    inside = camera.shows(pixels, z)
    column, row = pixels[inside].long().unbind(-1)
    z = z[inside]
    still = torch.ones_like(depth, dtype=torch.bool)
    for name in clip.kinds:
        still &= ~clip.store.mask(name, position)
    seen = depth[row, column]
    keep = (seen > 0) & still[row, column]
    return seen[keep] / z[keep]


def _agreed(ratios: Float[Tensor, " R"]) -> float | None:
    """The commonest ratio; points behind others fall below it, so a mean would not do.

    None unless there are at least 200, a quarter of them near it.
    """
    if len(ratios) < 200:
        return None
    logs = ratios.log()
    counts = torch.histc(logs, 150, -1.5, 1.5)  # 2 % each
    near = torch.nn.functional.conv1d(counts[None, None], counts.new_ones(1, 1, 5), padding=2)[0, 0]
    peak = -1.5 + (int(near.argmax()) + 0.5) * 0.02
    close = logs[(logs - peak).abs() < 0.06]
    return float(close.median().exp()) if len(close) > 0.25 * len(ratios) else None


def _jitter(name: str, rotations: Float[Tensor, "F J 3"]) -> Iterator[Diagnostic]:
    """Each joint against a cubic through the two frames before and the two after, about it.

    Not against the middle of its neighbours: at a few frames a second a body's own acceleration
    is as large there as noise. And of the quarter of joints that are least off: noise is on all of
    them, while a body that moves fast moves some.
    """
    if len(rotations) < LEAST_POSES:
        return
    quats = axis_angle_to_quats(rotations)
    around = [turn_between(quats[2:-2], quats[i : len(quats) - 4 + i]) for i in (0, 1, 3, 4)]
    off = (4 * (around[1] + around[2]) - around[0] - around[3]) / 6
    degrees = float(torch.rad2deg(off.norm(dim=-1).quantile(0.25)))
    if degrees > JITTER_DEGREES:
        yield Diagnostic(
            "pose-noise",
            f'body poses of "{name}" jitter: three joints in four are more than {degrees:.1f} '
            "degrees off a smooth path through the frames before and after",
            "smooth the poses, or let training refine them more (train.rates.pose, "
            "docs/reference/refinement.md)",
        )


def _gaps(clip: Clip) -> Iterator[Diagnostic]:
    """Steps that are far longer than their neighbours in two tracks: frames are missing there.

    A clip with the times of its frames misses none: its motion follows them.
    """
    if clip.frame_times is not None:
        return
    tracks = {"the camera": torch.stack([c.center for c in clip.cameras])}
    for name, body in clip.bodies.items():
        turns = 0.1 * body.poses.rotations.flatten(1)  # radians at an arm's length or so
        tracks[f'"{name}"'] = torch.cat((body.poses.transl, turns), 1)
    for name, track in clip.objects.items():
        turns = 0.1 * track.rotations.flatten(1)
        tracks[f'"{name}"'] = torch.cat((track.translations, turns), 1)
    votes = [_standing_out(path) for path in tracks.values()]
    steps = (torch.stack(votes).sum(0) >= 2).nonzero().squeeze(1).tolist()
    if steps:
        where: Sequence[str] = [f"{s} and {s + 1}" for s in steps[:6]]
        yield Diagnostic(
            "missing-frames",
            f"frames are missing between {', '.join(where)}{', …' if len(steps) > 6 else ''}: what "
            "moves goes much further there than in the steps before and after",
            "take the frames from the video again without dropping any, or give the clip its times "
            "(docs/reference/clip.md); motion is interpolated across the gaps",
            tuple(steps),
        )


def _standing_out(path: Float[Tensor, "F D"]) -> Int[Tensor, " S"]:
    """Votes of one track for a gap at each step: 1 where it goes much further than in the steps
    about it, 2 where it does so though it is steady everywhere else, and -1 where it moves and goes
    no further than there, as nothing that moves does across a gap.

    Much further than the second largest of the four about it: not than the largest, so that two
    gaps close together do not hide each other; not than the middle one, so that a start from rest
    is none.
    """
    steps = (path[1:] - path[:-1]).norm(dim=-1)
    if len(steps) < 5 or float(steps.median()) < 1e-4:
        return torch.zeros(len(steps), dtype=torch.long)
    padded = torch.cat((steps[[2, 1]], steps, steps[[-2, -3]]))
    about = torch.stack([padded[i : i + len(steps)] for i in (0, 1, 3, 4)])
    second = about.sort(0).values[-2]
    logs = (steps / second.clamp_min(0.2 * float(steps.median()))).clamp_min(1e-6).log()
    spread = max(float((logs - logs.median()).abs().median()), 0.01)
    out = logs > math.log(GAP)
    against = (second > 0.5 * steps.median()) & (logs < math.log(NO_GAP))
    return out.long() + (out & (logs > STEADY * spread)).long() - against.long()
