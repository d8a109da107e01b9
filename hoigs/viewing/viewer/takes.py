"""Takes: screenshots, a path of views and its film; and where things are, to orbit about them."""

from __future__ import annotations

import queue
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path as FilePath

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from hoigs.core.maths.rotations import matrices_to_quats, quats_to_matrices, slerp
from hoigs.core.system.video_files import write_video
from hoigs.core.values.clip import Clip
from hoigs.viewing.viewer.panes import nearest_position
from hoigs.viewing.viewer.run_drawing import Drawing, RunDrawing
from hoigs.viewing.viewer.views import Vector, View

FILM_FPS = 30
AHEAD = 4  # pictures that are drawn and not yet encoded, at most
MOST_KEYS = 100  # views on a path


@dataclass
class Path:
    """Views with the frame number at which each was taken, in order."""

    keys: list[tuple[float, View]] = field(default_factory=list)

    def __str__(self) -> str:
        frames = ", ".join(f"{frame:.1f}" for frame, _ in self.keys)
        places = f", at frames {frames}" if frames else ""
        more = "" if len(self.keys) > 1 else " A film needs two or more."
        return f"Views on the path: {len(self.keys)}{places}.{more}"

    def at(self, share: float) -> tuple[float, View]:
        """Frame number and view at a share of the path, in [0, 1].

        Eye and target follow Catmull-Rom splines, which pass through every key; the frame number
        is linear in between, so that two keys of one frame let time stand still.
        """
        place = min(max(share, 0.0), 1.0) * (len(self.keys) - 1)
        low = min(int(place), max(len(self.keys) - 2, 0))
        high = min(low + 1, len(self.keys) - 1)
        r = place - low
        (frame_a, a), (frame_b, b) = self.keys[low], self.keys[high]
        before = self.keys[max(low - 1, 0)][1]
        after = self.keys[min(high + 1, len(self.keys) - 1)][1]
        eye = _catmull_rom(before.position, a.position, b.position, after.position, r)
        target = _catmull_rom(before.target, a.target, b.target, after.target, r)
        turns = [matrices_to_quats(torch.from_numpy(v.rotation.copy())) for v in (a, b)]
        rotation = quats_to_matrices(slerp(turns[0], turns[1], r)).numpy()
        view = View(eye, target, rotation, a.up, a.fov + (b.fov - a.fov) * r)
        return frame_a + (frame_b - frame_a) * r, view


class Film:
    """The path as an mp4 in the making: a picture is drawn at each `step`, in the thread of whoever
    calls it, and another thread encodes them, so that other pictures can be drawn in between.

    Args:
        path: as it is now. seconds: of the film.
        draw: a picture at a frame number from a view; all of one even size.

    Attributes:
        drawn, count: pictures.
    """

    def __init__(
        self, path: Path, seconds: float, draw: Callable[[float, View], UInt8[np.ndarray, "H W 3"]]
    ) -> None:
        self.drawn, self.count = 0, max(2, round(seconds * FILM_FPS))
        self._path, self._draw = Path(list(path.keys)), draw
        self._frames = queue.Queue[UInt8[np.ndarray, "H W 3"] | None]()
        self._made: Future[bytes] = Future()
        threading.Thread(target=self._encode, daemon=True).start()

    def step(self) -> bytes | None:
        """Draw one more, unless the encoder is behind; the whole file once it is done.

        Raises:
            Exception: the drawing or the encoding failed, as it said itself.
        """
        if self._made.done():
            return self._made.result()
        if self.drawn < self.count and self._frames.qsize() < AHEAD:
            self._frames.put(self._draw(*self._path.at(self.drawn / (self.count - 1))))
            self.drawn += 1
            if self.drawn == self.count:
                self._frames.put(None)
        return None

    def cancel(self) -> None:
        """Let go of it; the encoder ends with what it has."""
        self._frames.put(None)

    def _drawn_ones(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        while (frame := self._frames.get()) is not None:
            yield frame

    def _encode(self) -> None:
        try:
            with tempfile.TemporaryDirectory() as folder:
                file = FilePath(folder) / "path.mp4"
                write_video(file, self._drawn_ones(), fps=FILM_FPS)
                self._made.set_result(file.read_bytes())
        except Exception as error:
            self._made.set_exception(error)


def png(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """An image as the bytes of a PNG file."""
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "png")
    return buffer.getvalue()


def distance_to_subject(clip: Clip) -> float:
    """From the first camera to what moves, else to the middle of the scene's points, metres."""
    camera = clip.cameras[0]
    places = [track.poses.transl[0] for track in clip.bodies.values()]
    places = places or [track.translations[0] for track in clip.objects.values()]
    if not places and len(clip.points):
        places = [clip.points.median(0).values]
    depths = [float(camera.to_camera(p.to(camera.K))[2]) for p in places]
    return max(float(np.mean(depths)), 0.1) if depths else 2.0


def center(drawing: Drawing, name: str, frame: float) -> Vector:
    """The middle of an entity at a frame number, world, metres."""
    if isinstance(drawing, RunDrawing):
        means = drawing.gaussians(frame).means[drawing.rows()[name]]
        return means.double().median(0).values.cpu().numpy()
    clip = drawing.clip
    i = nearest_position(clip, frame)
    if name in clip.objects:
        return clip.objects[name].translations[i].double().numpy()
    return clip.bodies[name].poses.transl[i].double().numpy()


def turned_to(view: View, goal: Vector, up: Vector) -> View:
    """The view from the same place, turned to look at a point."""
    forward = (goal - view.position) / max(float(np.linalg.norm(goal - view.position)), 1e-9)
    right = np.cross(-up, forward)
    right /= max(float(np.linalg.norm(right)), 1e-9)
    rotation = np.stack((right, np.cross(forward, right), forward), 1)
    return replace(view, target=goal, rotation=rotation, up=up)


def _catmull_rom(a: Vector, b: Vector, c: Vector, d: Vector, r: float) -> Vector:
    """From b (r = 0) to c (r = 1), with tangents (c - a) / 2 and (d - b) / 2."""
    m, n = (c - a) / 2, (d - b) / 2
    s, t = r * r, r * r * r
    return (2 * t - 3 * s + 1) * b + (t - 2 * s + r) * m + (3 * s - 2 * t) * c + (t - s) * n
