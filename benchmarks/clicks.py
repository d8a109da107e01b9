"""One click on things in real recordings: how many frames are right, partial, wrong and empty.

    python benchmarks/clicks.py                        # all cases, about a minute each
    python benchmarks/clicks.py club board-cam03 --sheet build/sheets --jobs 8
    python benchmarks/clicks.py --anywhere 6           # the first mask alone, of clicks anywhere
    python benchmarks/clicks.py --no-network           # by colours, edges and motion alone

Real frames with truth. Into recordings of shared/data an object is drawn whose mask is known: it
follows landmarks of a hand or flies, is blurred by its motion, softened, given noise, and the whole
is compressed again. The board of fourviews has a known pose, and the ball of juggle a known disc.
The person's masks and landmarks are those that `hoigs prepare` finds in the recording; they are
kept in --cache. Of a drawn object the person's masks take in what is near the hand, as a
segmenter's do.

A frame is right from an intersection over union of 0.5, partial where half of the mask or more is
the object's, else wrong; a mask where the object is out of the picture is wrong, none there is
right. Of a racket and a club both masks are grown by 2 pixels, and a racket's head may be filled.
`said`: wrong frames of which the tracker says that they are doubtful.

With --anywhere the clicks are at random pixels of the object, in random frames, the same at each
call, and the mask of the clicked frame is judged.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np
from object_tracking import click_on
from PIL import Image, ImageDraw
from scipy import ndimage

from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    Estimates,
    FramePrompt,
    Landmarks,
    PromptPoint,
    VideoRequest,
)
from hoigs.plugins.estimators.object_tracker import footage as tracker_footage
from hoigs.plugins.estimators.object_tracker import scene as tracker_scene
from hoigs.plugins.estimators.object_tracker.estimator import WEAK, ObjectTrackerEstimator
from hoigs.plugins.estimators.object_tracker.outlined import clicked_mask
from hoigs.plugins.estimators.object_tracker.outlines import Outlines
from hoigs.plugins.estimators.object_tracker.states import DOUBTFUL

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).resolve().parents[2] / "shared"))
DATA = SHARED / "data"
FINE = 3  # pixels of the drawing in one of the video
MOMENTS, SHUTTER = 6, 0.5  # drawings in one exposure, and its share of the time between frames
SOFT, NOISE, QUALITY = 0.6, 2.0, "23"  # blur of the lens, pixels; noise, of 255; CRF of H.264


def recording(name: str) -> Path:
    folder = "fourviews" if name.startswith("cam") else name
    return DATA / folder / (f"{name}.mp4" if folder == "fourviews" else "video.mp4")


def frames_of(source) -> list[np.ndarray]:
    with av.open(source) as video:
        return [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]


def prepare(name: str, cache: Path) -> None:
    """Find masks and landmarks of a recording, unless they are there."""
    file = cache / f"{name}.npz"
    if file.is_file():
        return
    from hoigs.preparation.kept import last_kept
    from hoigs.preparation.prepare import prepare_until, work_folder

    out, alone = cache / "prepared" / name, cache / "alone" / f"{name}.mp4"
    alone.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(recording(name), alone)  # masks may lie beside it, and would be taken
    prepare_until("estimates", alone, out, object="none", estimators="offline", yes=True)
    found = last_kept(work_folder(out), "estimates")["estimates"]
    masks = np.stack([found.masks.human[i] for i in range(len(found.masks.human))])
    arrays = {}
    for person, track in found.landmarks.items():
        image = track.image.numpy()
        arrays[f"lm {person}"] = np.zeros((*image.shape[:2], 4), np.float32)
        arrays[f"lm {person}"][..., [0, 1, 3]] = image
    np.savez_compressed(file, m=np.packbits(masks, axis=-1), shape=masks.shape, **arrays)


def estimates_of(name: str, cache: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """The person's masks [F, H, W] and landmarks [F, 33, 4] (x, y, 0, visibility)."""
    prepare(name, cache)
    with np.load(cache / f"{name}.npz") as kept:
        masks = np.unpackbits(kept["m"], axis=-1)[..., : kept["shape"][2]].astype(bool)
        tracks = [kept[k] for k in kept.files if k.startswith("lm ")]
    return masks, tracks[0] if tracks else None


# What is drawn: polygons and lines x, y in pixels, with colours r, g, b, alpha.

Drawing = list[tuple[np.ndarray, float, tuple[int, int, int, int]]]  # width 0: a filled polygon


@dataclass(frozen=True)
class Body:
    """Landmarks of the person at times between frames."""

    points: np.ndarray  # [F, 33, 2]

    def at(self, k: int | tuple[int, ...], t: float) -> np.ndarray:
        track = self.points[:, np.atleast_1d(k)].mean(1)
        track = ndimage.gaussian_filter1d(track, 1.0, axis=0, mode="nearest")
        return np.array([np.interp(t, np.arange(len(track)), track[:, a]) for a in range(2)])

    def hand(self, side: str, t: float) -> np.ndarray:
        return self.at((17, 19) if side == "left" else (18, 20), t)

    def forearm(self, side: str, t: float) -> float:
        elbow = self.at(13 if side == "left" else 14, t)
        return float(np.arctan2(*(self.hand(side, t) - elbow)[::-1]))

    @property
    def reach(self) -> float:
        """Pixels from a shoulder to the other, which say how large the person is."""
        return float(np.median(np.hypot(*(self.points[:, 11] - self.points[:, 12]).T)))


def turned(points, angle: float, at=(0.0, 0.0)) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points, float) @ np.array([[c, s], [-s, c]]) + at


def oval(rx: float, ry: float, middle=(0.0, 0.0)) -> np.ndarray:
    a = np.linspace(0, 2 * np.pi, 48)
    return np.stack((rx * np.cos(a), ry * np.sin(a)), -1) + middle


def racket(body: Body, t: float) -> Drawing:
    angle = body.forearm("right", t) + 0.9 * np.sin(t / 6.0)
    at, white = body.hand("right", t), (225, 228, 215, 255)
    lines: Drawing = [(turned([(-14, 0), (58, 0)], angle, at), 6, (40, 40, 45, 255))]
    ring = oval(52, 40, (108, 0))
    for x in range(62, 158, 10):
        half = 40 * np.sqrt(max(0, 1 - ((x - 108) / 52) ** 2))
        lines.append((turned([(x, -half), (x, half)], angle, at), 1.2, white))
    for y in range(-35, 40, 10):
        half = 52 * np.sqrt(1 - (y / 40) ** 2)
        lines.append((turned([(108 - half, y), (108 + half, y)], angle, at), 1.2, white))
    return [*lines, (turned(ring, angle, at), 3, (200, 40, 50, 255))]


def club(body: Body, t: float) -> Drawing:
    swing = np.clip((t - 12) / 34, 0, 1)
    angle = np.pi / 2 + 0.5 - 3.4 * np.sin(np.pi * swing) ** 3 + 0.1 * np.sin(t / 5)
    at = body.hand("right", t)
    shaft = turned([(0, 0), (205, 0)], angle, at)
    grip = turned([(-25, 0), (25, 0)], angle, at)
    head = turned([(200, -4), (214, -4), (216, 14), (203, 16)], angle, at)
    grey, dark = (175, 178, 185, 255), (35, 35, 40, 255)
    return [(shaft, 3, grey), (grip, 4.5, dark), (head, 0, dark)]


def paper_cup(body: Body, t: float) -> Drawing:
    up = np.clip((t - 14) / 10, 0, 1) - np.clip((t - 36) / 10, 0, 1)
    mouth = body.at((9, 10), t) + np.array((0, 3))
    at = (1 - up) * body.hand("right", t) + up * mouth
    cup = turned([(-5, -6), (5, -6), (3.8, 6), (-3.8, 6)], 0.5 * up, at)
    band = turned([(-4.7, -2), (4.7, -2), (4.2, 2), (-4.2, 2)], 0.5 * up, at)
    return [(cup, 0, (240, 236, 228, 255)), (band, 0, (190, 120, 60, 255))]


def thrown_ball(body: Body, t: float) -> Drawing:
    fly = max(t - 26, 0.0)
    at = body.hand("left", min(t, 26)) + np.array((18 * fly, -30 * fly + 1.1 * fly**2))
    skin = [(oval(34 - k, 34 - k, at - k / 3), 0, (200 + k, 145 + k, 118 + k, 255)) for k in (0, 8)]
    seam = [turned(oval(34 * w, 33), 0.1 * t, at) for w in (0.35,)]
    return [*skin, *((s, 1.5, (120, 80, 65, 255)) for s in seam)]


def three_cups(which: int) -> Callable[[Body, float], Drawing]:
    def draw(body: Body, t: float) -> Drawing:
        places = np.array([(120.0, 640.0), (260.0, 650.0), (400.0, 640.0)])
        for (a, b), start in (((0, 1), 8), ((1, 2), 26), ((0, 2), 44)):
            share = np.clip((t - start) / 14, 0, 1)
            way, bend = places[b] - places[a], np.sin(np.pi * share)
            places[a], places[b] = places[a] + share * way, places[b] - share * way
            places[a][1] += 26 * bend
            places[b][1] -= 26 * bend
        cups = []
        for k in np.argsort(places[:, 1]):
            x, y = places[k]
            shape = np.array([(-24, 34), (24, 34), (31, -34), (-31, -34)][::-1], float)
            shape[:, 1] *= -1
            cup: Drawing = [
                (shape + np.array((x, y)), 0, (35, 120, 70, 255)),
                (np.array([(-12, 34), (-4, 34), (-6, -34), (-17, -34)]) * (1, -1) + (x, y), 0,
                 (90, 165, 115, 255)),
                (np.array([(x - 31, y + 30), (x + 31, y + 30)]), 4, (20, 85, 50, 255)),
            ]  # fmt: skip
            cups += [(*part, bool(k == which)) for part in cup]
        return cups

    return draw


def bottle(body: Body, t: float) -> Drawing:
    angle = body.forearm("left", t) + np.pi / 2 + 0.3 * np.sin(t / 9)
    at = body.hand("left", t)
    side = np.array([(-24, 70), (24, 70), (26, -20), (10, -58), (-10, -58), (-26, -20)], float)
    shine = np.array([(-18, 60), (-12, 60), (-12, -25), (-18, -25)], float)
    cap = np.array([(-10, -58), (10, -58), (10, -70), (-10, -70)], float)
    rim = turned(np.concatenate((side, side[:1])), angle, at)
    return [
        (turned(side, angle, at), 0, (190, 215, 225, 77)),
        (rim, 3, (210, 230, 235, 150)),
        (turned(shine, angle, at), 0, (250, 250, 250, 130)),
        (turned(cap, angle, at), 0, (40, 90, 200, 255)),
    ]


def plate(body: Body, t: float) -> Drawing:
    at = body.at((11, 12), t) + np.array((-62, 10 + 70 * np.sin(t / 7) ** 2))
    marks = [turned([(24, -6), (34, -6), (34, 6), (24, 6)], a + t / 20, at) for a in (0, 2.1, 4.2)]
    return [
        (oval(46, 46, at), 0, (38, 38, 42, 255)), (oval(40, 40, at), 3, (70, 70, 76, 255)),
        *((m, 0, (205, 205, 200, 255)) for m in marks), (oval(9, 9, at), 0, (160, 162, 165, 255)),
    ]  # fmt: skip


def box(side: str, size: float, rate: float) -> Callable[[Body, float], Drawing]:
    cells = np.random.default_rng(3).uniform(50, 220, (6, 4, 4, 3)) * (1.0, 0.85, 0.6)
    faces = [(axis, sign) for axis in range(3) for sign in (-1, 1)]

    def draw(body: Body, t: float) -> Drawing:
        a, b = rate * t, 0.5 + 0.4 * np.sin(rate * t)
        spin = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        tilt = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        parts: Drawing = []
        for f, (axis, sign) in enumerate(faces):
            normal = (tilt @ spin)[:, axis] * sign
            if normal[2] > -0.02:
                continue
            grid = np.linspace(-1, 1, 5)
            for r in range(4):
                for c in range(4):
                    corners = np.zeros((4, 3))
                    corners[:, axis] = sign
                    ends = [(r, c), (r + 1, c), (r + 1, c + 1), (r, c + 1)]
                    corners[:, [k for k in range(3) if k != axis]] = [
                        (grid[p], grid[q]) for p, q in ends
                    ]
                    seen = corners * (1, 0.7, 0.5) @ (tilt @ spin).T
                    flat = size * seen[:, :2] / (1 + 0.12 * seen[:, 2:])
                    color = (*(cells[f, r, c] * (0.55 - 0.45 * normal[2])).astype(int), 255)
                    parts.append((flat + body.hand(side, t) + (0, -0.3 * size), 0, color))
        return parts

    return draw


def carried_cup(body: Body, t: float) -> Drawing:
    up = np.sin(np.pi * np.clip((t - 16) / 36, 0, 1))
    x, y = 250 + 260 * np.clip((t - 20) / 28, 0, 1), 640 - 150 * up
    shape = turned([(-22, -28), (22, -28), (19, 28), (-19, 28)], 0.5 * up, (x, y))
    handle = turned(oval(12, 14, (24, 0)), 0.5 * up, (x, y))
    stripe = turned([(-21, -8), (21, -8), (20, 4), (-20, 4)], 0.5 * up, (x, y))
    return [(handle, 5, (225, 190, 60, 255)), (shape, 0, (235, 200, 70, 255)),
            (stripe, 0, (70, 60, 130, 255))]  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One recording with one click.

    Attributes:
        first, last: frames of the recording. drawn: what is drawn into it; None: its own object.
        click: frame of the case, and of the board its place in half sides from the middle.
        thin: compared with masks grown by 2 pixels. hand: that it follows, near which the person's
            masks take it in.
    """

    recording: str
    first: int
    last: int
    drawn: Callable | None = None
    click: tuple[int, float, float] = (0, 0.0, 0.0)
    thin: bool = False
    hand: str = ""


CASES = {
    "racket": Case("juggle", 0, 52, racket, (8, 0, 0), True, "right"),
    "club": Case("juggle", 80, 132, club, (3, 0, 0), True, "right"),
    "paper-cup": Case("juggle", 160, 212, paper_cup, (4, 0, 0), False, "right"),
    "thrown-ball": Case("cam03", 0, 52, thrown_ball, (20, 0, 0), False, "left"),
    "shell-game": Case("coffee", 0, 60, three_cups(0)),
    "shell-game-2": Case("coffee", 0, 60, three_cups(1), (3, 0, 0)),
    "bottle": Case("cam04", 6, 58, bottle, (30, 0, 0), False, "left"),
    "plate": Case("juggle", 20, 72, plate, (10, 0, 0)),
    "box": Case("cam04", 6, 58, box("right", 75, 0.09), (15, 0, 0), False, "right"),
    "box-moving": Case("backpack", 0, 52, box("left", 38, 0.07), (10, 0, 0), False, "left"),
    "carried-cup": Case("coffee", 80, 140, carried_cup, (3, 0, 0)),
    "board-cam02": Case("cam02", 60, 111, click=(28, 0.1, 0.1)),
    "board-cam03": Case("cam03", 60, 111, click=(28, 0.1, 0.1)),
    "board-cam04": Case("cam04", 60, 111, click=(28, 0.1, 0.1)),
    "board-cam02-late": Case("cam02", 60, 111, click=(45, -0.6, 0.5)),
    "board-cam03-early": Case("cam03", 60, 111, click=(10, 0.5, -0.5)),
    "board-cam04-rim": Case("cam04", 60, 111, click=(42, 0.0, 0.8)),
    "ball-juggle": Case("juggle", 0, 60),
    "ball-juggle-2": Case("juggle", 150, 210, click=(40, 0, 0)),
}  # fmt: skip
SAME_VIDEO = ("shell-game-2", "board-cam02-late", "board-cam03-early", "board-cam04-rim")
FEWEST = 40  # pixels of an object that is clicked anywhere


def painted(drawings: list[Drawing]) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """Rows and columns, there premultiplied colours and alpha [h, w, 4], 0 to 1, and the alpha of
    the object alone: the mean over several moments."""
    points = np.concatenate([p for drawing in drawings for p, *_ in drawing])
    low = np.floor(points.min(0)).astype(int) - 8
    w, h = np.ceil(points.max(0)).astype(int) + 8 - low
    total, alone = np.zeros((h, w, 4)), np.zeros((h, w))
    for drawing in drawings:
        image, own = Image.new("RGBA", (FINE * w, FINE * h)), Image.new("L", (FINE * w, FINE * h))
        for outline, width, color, *mine in drawing:
            at = [tuple(p) for p in (outline - low) * FINE]
            for canvas, fill in ((image, color), (own, 255 * all(mine))):
                pen = ImageDraw.Draw(canvas)
                if width:
                    pen.line(at, fill=fill, width=max(1, round(width * FINE)), joint="curve")
                else:
                    pen.polygon(at, fill=fill)
        rgba = np.asarray(image).astype(np.float32) / 255
        rgba[..., :3] *= rgba[..., 3:]
        total += rgba.reshape(h, FINE, w, FINE, 4).mean((1, 3)) / len(drawings)
        alone += np.asarray(own).reshape(h, FINE, w, FINE).mean((1, 3)) / 255 / len(drawings)
    return (slice(low[1], low[1] + h), slice(low[0], low[0] + w)), total, alone


def pasted(part: np.ndarray, at: tuple[slice, slice], shape: tuple[int, int]) -> np.ndarray:
    """A part in a picture of zeros, cut off at its edges."""
    full = np.zeros((*shape, *part.shape[2:]), np.float32)
    ends = [(max(s.start, 0), min(s.stop, n)) for s, n in zip(at, shape)]
    if all(a < b for a, b in ends):
        to = tuple(slice(a, b) for a, b in ends)
        full[to] = part[tuple(slice(a - s.start, b - s.start) for (a, b), s in zip(ends, at))]
    return full


@dataclass
class Footage:
    """A case's frames, the person's masks and landmarks, and the object's true masks; None where
    they are unknown."""

    frames: list[np.ndarray]
    person: list[np.ndarray]
    landmarks: np.ndarray | None
    truth: list[np.ndarray | None]
    places: list[tuple[float, float] | None] = field(default_factory=list)


def footage_of(case: Case, cache: Path) -> Footage:
    frames = frames_of(str(recording(case.recording)))[case.first : case.last]
    masks, landmarks = estimates_of(case.recording, cache)
    masks = list(masks[case.first : case.last])
    landmarks = None if landmarks is None else landmarks[case.first : case.last]
    if case.drawn is not None:
        return drawn_into(frames, masks, landmarks, case)
    if case.recording.startswith("cam"):
        truth, places = board_truth(case)
        return Footage(frames, masks, landmarks, truth, places)
    track = np.load(DATA / "juggle" / "ball_track.npz")["xyr"][case.first : case.last]
    y, x = np.mgrid[: frames[0].shape[0], : frames[0].shape[1]] + 0.5
    disc = [np.hypot(x - a, y - b) <= r if np.isfinite(a) else None for a, b, r in track]
    return Footage(frames, masks, landmarks, disc)


def drawn_into(frames, masks, landmarks, case: Case) -> Footage:
    known = landmarks
    if known is None or not np.isfinite(known).all():
        known = np.zeros((len(frames), 33, 4))  # nothing that is drawn there follows the body
    body, shape = Body(known[..., :2]), frames[0].shape[:2]
    rng, out, truth = np.random.default_rng(0), [], []
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    for i, image in enumerate(frames):
        moments = i + SHUTTER * np.arange(MOMENTS) / MOMENTS
        at, layer, mine = painted([case.drawn(body, t) for t in moments])
        layer = pasted(ndimage.gaussian_filter(layer, (SOFT, SOFT, 0)), at, shape)
        mine = pasted(mine, at, shape)
        mixed = image * (1 - layer[..., 3:]) + 255 * layer[..., :3]
        mixed += NOISE * rng.normal(size=mixed.shape) * (layer[..., 3:] > 0.1)
        out.append(np.rint(mixed).clip(0, 255).astype(np.uint8))
        truth.append(mine > 0.3)
        if case.hand:
            at = body.hand(case.hand, i)
            masks[i] = masks[i] | (truth[-1] & (np.hypot(x - at[0], y - at[1]) < 0.25 * body.reach))
    return Footage(compressed(out), masks, landmarks, truth)


def compressed(frames: list[np.ndarray]) -> list[np.ndarray]:
    """After H.264, as a camera writes it."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as video:
        stream = video.add_stream("libx264", rate=25, options={"crf": QUALITY})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        video.mux(stream.encode())
    file.seek(0)
    return frames_of(file)


def board_truth(case: Case):
    """Masks of the board by its pose in four views; None where it is unknown. And the place of the
    click in each frame."""
    camera = json.loads((DATA / "fourviews" / "cameras.json").read_text())["cameras"][
        case.recording
    ]
    known = np.load(DATA / "fourviews" / "truth.npz")
    k, lens = np.array(camera["K"]), np.array(camera["distortion"])
    pose, half = np.array(camera["world_to_camera"]), known["board_size"] / 2 + 0.03

    def seen(points: np.ndarray) -> np.ndarray:
        c = points @ pose[:3, :3].T + pose[:3, 3]
        x, y = (c[:, :2] / c[:, 2:]).T
        r = x * x + y * y
        g = 1 + r * (lens[0] + r * (lens[1] + r * lens[4]))
        u = x * g + 2 * lens[2] * x * y + lens[3] * (r + 2 * x * x)
        v = y * g + lens[2] * (r + 2 * y * y) + 2 * lens[3] * x * y
        return np.stack((u, v), -1) * (k[0, 0], k[1, 1]) + k[:2, 2] + 0.5

    truth, places = [], []
    for i in range(case.first, case.last):
        if not known["board_valid"][i]:
            truth.append(None)
            places.append(None)
            continue
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), case.click[1:]]) * half
        world = np.pad(corners, ((0, 0), (0, 1))) @ known["board_rotation"][i].T
        *rim, place = seen(world + known["board_center"][i])
        image = Image.new("1", (1280, 720))
        ImageDraw.Draw(image).polygon([tuple(p) for p in rim], fill=1)
        truth.append(np.asarray(image))
        places.append(tuple(place))
    return truth, places


def verdict(mask: np.ndarray, true: np.ndarray, thin: bool) -> tuple[str, float]:
    """right, partial, wrong or empty, and the intersection over union."""
    if not true.any():
        return ("wrong", 0.0) if mask.any() else ("right", 1.0)
    if not mask.any():
        return "empty", 0.0
    if thin:
        mask, true = (ndimage.binary_dilation(m, iterations=2) for m in (mask, true))
    forms = [true, ndimage.binary_fill_holes(true)] if thin else [true]
    iou = max(float((mask & t).sum() / (mask | t).sum()) for t in forms)
    on = float((mask & forms[-1]).sum() / mask.sum())
    return "right" if iou >= 0.5 else "partial" if on >= 0.5 else "wrong", iou


def request(film: Footage, work: Path, entities: tuple[EntityRequest, ...] = ()) -> VideoRequest:
    landmarks = None if film.landmarks is None else {"human": Landmarks(film.landmarks)}
    known = Estimates(EntityMasks({"human": film.person}), landmarks)
    (height, width), frames = film.frames[0].shape[:2], film.frames
    return VideoRequest(
        len(frames), width, height, lambda i: frames[i], work, work, entities=entities, known=known
    )


def anywhere(name: str, cache: Path, count: int, network: bool) -> dict:
    """The masks of `count` clicks at random pixels of the object in random frames."""
    case, rng = CASES[name], np.random.default_rng(7)
    film = footage_of(case, cache)
    video = request(film, cache)
    footage = tracker_footage.read_footage(video, film.person)
    still = tracker_scene.is_static(footage)
    scene = (tracker_scene.static_scene if still else tracker_scene.moving_scene)(footage)
    shown = [i for i, true in enumerate(film.truth) if true is not None and true.sum() > FEWEST]
    counts, ious, start = Counter(), [], time.process_time()
    outlines = Outlines(footage.shape, video.frame) if network else None
    for _ in range(count):
        i = shown[rng.integers(len(shown))]
        y, x = np.argwhere(film.truth[i])[rng.integers(film.truth[i].sum())] + 0.5
        prompt = FramePrompt(i, (PromptPoint(float(x), float(y)),))
        soft = Image.fromarray(
            np.uint8(255 * clicked_mask(footage, scene, i, prompt, None, outlines).soft)
        )
        mask = np.asarray(soft.resize((video.width, video.height), Image.Resampling.BILINEAR)) > 127
        word, iou = verdict(mask, film.truth[i], case.thin)
        counts[word] += 1
        ious.append(iou)
    if outlines is not None:
        outlines.close()
    row = {"case": name} | {k: counts[k] for k in ("right", "partial", "wrong", "empty")}
    seconds = time.process_time() - start
    return row | {"said": 0, "click": None, "iou": float(np.mean(ious)), "seconds": seconds}


def run(name: str, cache: Path, sheet: Path | None, network: bool) -> dict:
    case = CASES[name]
    film = footage_of(case, cache)
    at = case.click[0]
    x, y = film.places[at] if film.places else click_on(film.truth[at])[:2]
    with tempfile.TemporaryDirectory() as work:
        frames = film.frames
        entity = EntityRequest(
            "object", "object", points=(PromptPoint(float(x), float(y)),), frame=at
        )
        video = request(film, Path(work), (entity,))
        start = time.process_time()
        row: dict = {"case": name}
        try:
            found = ObjectTrackerEstimator(network=network).estimate(video).masks
        except Exception as error:  # a click on nothing is a result, too
            return row | {"error": str(error).splitlines()[0]}
        row["seconds"] = time.process_time() - start
        masks = [found.entities["object"][i] for i in range(len(frames))]
    counts, said, ious, words, states = Counter(), 0, [], [], found.states["object"]
    for i, (mask, true) in enumerate(zip(masks, film.truth, strict=True)):
        if true is None:
            words.append("?")
            continue
        word, iou = verdict(mask, true, case.thin)
        counts[word] += 1
        doubtful = states[i] == DOUBTFUL or found.confidence["object"][i] < WEAK
        said += bool(word == "wrong" and doubtful)
        ious += [iou] if mask.any() else []
        words.append(word)
    first = film.truth[at]
    row |= {k: counts[k] for k in ("right", "partial", "wrong", "empty")} | {"said": said}
    row["click"] = verdict(masks[at], first, case.thin)[1] if first is not None else None
    row["iou"] = float(np.mean(ious)) if ious else 0.0
    row["states"] = dict(Counter(states))
    row["notes"] = list(found.notes)
    if sheet is not None:
        draw(film, masks, found.confidence["object"], words, sheet / f"{name}.png", at)
    return row


def draw(film: Footage, masks, confidence, words, path: Path, at: int) -> None:
    """Sixteen frames where the object ever is: its mask in red, the true outline in green."""
    tiles, shown = [], np.any([t for t in film.truth if t is not None], axis=0)
    rows, columns = (np.flatnonzero(shown.any(a)) for a in (1, 0))
    part = (max(columns[0] - 40, 0), max(rows[0] - 40, 0), columns[-1] + 40, rows[-1] + 40)
    picks = sorted({at, *np.linspace(0, len(masks) - 1, 15).astype(int).tolist()})
    for i in picks:
        image = film.frames[i].copy()
        image[masks[i]] = image[masks[i]] // 2 + np.uint8([125, 0, 0])
        true = film.truth[i]
        if true is not None:
            image[true ^ ndimage.binary_erosion(true)] = (0, 255, 0)
        tile = Image.fromarray(image).crop(part)
        scale = min(480 / tile.width, 360 / tile.height)
        small = tile.resize((round(scale * tile.width), round(scale * tile.height)))
        tile = Image.new("RGB", (480, 360))
        tile.paste(small)
        mark = "CLICK " if i == at else ""
        ImageDraw.Draw(tile).text(
            (4, 4), f"{mark}{i} {words[i]} {confidence[i]:.2f} {masks[i].sum()}", fill=(255, 255, 0)
        )
        tiles.append(np.asarray(tile))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 4)
    rows = [np.concatenate(tiles[k : k + 4], 1) for k in range(0, len(tiles), 4)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", help=", ".join(CASES))
    parser.add_argument("--cache", type=Path, default=Path("build/clicks"))
    parser.add_argument("--sheet", type=Path, help="folder for pictures of the masks")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--anywhere", type=int, help="random clicks in each video")
    parser.add_argument("--network", action=argparse.BooleanOptionalAction, default=True)
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    names, rows, task, last = args.cases or list(CASES), [], run, args.sheet
    if args.anywhere:
        task, last = anywhere, args.anywhere
        names = args.cases or [n for n in CASES if n not in SAME_VIDEO]
    print("| case | right | partial | wrong | said | empty | click | IoU | s | states |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor(args.jobs) as pool:
        recordings = {CASES[name].recording for name in names}
        list(pool.map(prepare, recordings, [args.cache] * len(recordings)))  # once each
        for row in pool.map(
            task, names, *([x] * len(names) for x in (args.cache, last, args.network))
        ):
            rows.append(row)
            if "error" in row:
                print(f"| {row['case']} | {row['error']} |", flush=True)
                continue
            states = ", ".join(f"{k} {n}" for k, n in row.get("states", {}).items())
            click = "-" if row["click"] is None else f"{row['click']:.2f}"
            print(
                f"| {row['case']} | {row['right']} | {row['partial']} | {row['wrong']} "
                f"| {row['said']} | {row['empty']} | {click} | {row['iou']:.2f} "
                f"| {row['seconds']:.0f} | {states} |", flush=True,
            )  # fmt: skip
    words = ("right", "partial", "wrong", "said", "empty")
    total = [str(sum(row.get(word, 0) for row in rows)) for word in words]
    print(f"| all | {' | '.join(total)} |")
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
