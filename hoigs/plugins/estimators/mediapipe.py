"""estimator:mediapipe: MediaPipe's landmarks and masks of a person, in an environment of its own.

mediapipe 0.10.21, the last wheel that contains its models, needs numpy below 2, which hoigs does
not. So `mediapipe_script.py` is run by the Python of an environment that hoigs makes, or that the
user names; it reads frames from standard input and writes one file.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EstimateKind,
    Estimates,
    Estimator,
    Landmarks,
    LazyFrames,
    VideoRequest,
)
from hoigs.core.progress import Progress, no_progress
from hoigs.plugins.estimators.common.environments import HEAVY, MEDIAPIPE
from hoigs.plugins.estimators.common.subprocess import run_tool, settings_key

SCRIPT = Path(__file__).with_name("mediapipe_script.py")
IMPORTED = [SCRIPT.with_name(f"mediapipe_{name}.py") for name in ("guided", "chosen")]
INSTALL = "run `hoigs estimators install mediapipe` and leave `python` out"
OTHERS, FOLLOWED = 0.1, 0.8  # shares of the frames, above and below which there is something to say
HIPS = [23, 24]  # of the 33 landmarks
LONGEST = 1280  # pixels: larger frames are made smaller, which the models do in any case


class MediapipeConfig(ComponentConfig):
    """Settings of `estimator:mediapipe`."""

    python: Path | None = Field(
        default=None,
        description="the Python of an environment of your own with mediapipe and OpenCV, such as "
        "ENV/bin/python, relative to the video's folder; None: that of `hoigs estimators install "
        "mediapipe`",
    )
    complexity: int = Field(
        default=2,
        ge=0,
        le=2,
        description="complexity of the model; 2 is the heavy one, in place of which 1 is used "
        "where the environment has it not; mediapipe downloads 0 itself",
    )
    masks: bool = Field(default=True, description="find the person's mask, too")
    smooth: bool = Field(default=True, description="use MediaPipe's filter over time")
    detection_confidence: float = Field(
        default=0.5, ge=0, le=1, description="confidence below which no person is found"
    )
    tracking_confidence: float = Field(
        default=0.5, ge=0, le=1, description="confidence below which the person is detected anew"
    )


class _IfMasks:
    """`provides`: of the class, all that it may give; of an instance, what its settings want."""

    def __get__(
        self, estimator: MediapipeEstimator | None, owner: type[MediapipeEstimator]
    ) -> frozenset[EstimateKind]:
        if estimator is None or estimator.config.masks:
            return frozenset(("landmarks", "masks"))
        return frozenset(("landmarks",))


class MediapipeEstimator(Estimator):
    """Landmarks and mask of the one person of a video by MediaPipe, in one pass over it.

    It follows a person from frame to frame and loses one that jumps, so it is given every frame
    from the first wanted one to the last. Where no landmarks are found it looks again with a
    border above the frame, and landmarks that are not on the person's mask are dropped. The mask is
    the mean of the segmentation of the frame, of the person's part of it, and of the pose's own.
    """

    Config: ClassVar = MediapipeConfig
    config: MediapipeConfig
    provides = _IfMasks()
    environment: ClassVar = MEDIAPIPE

    def _complexity(self) -> int:
        """The one that there is a model for."""
        own = self.config.python is not None
        if self.config.complexity < 2 or own or HEAVY.member not in MEDIAPIPE.lacking():
            return self.config.complexity
        return 1

    def _settings(self) -> dict[str, int | float]:
        """Arguments of `mediapipe.solutions.pose.Pose`."""
        return {
            "model_complexity": self._complexity(),
            "smooth_landmarks": self.config.smooth,
            "min_detection_confidence": self.config.detection_confidence,
            "min_tracking_confidence": self.config.tracking_confidence,
        }

    def commands(self) -> tuple[str, ...]:
        if self.config.python is None:
            return ()
        return (f"{self.config.python} -I {SCRIPT.name}",)

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        people = video.named("human") or ("human",)
        if len(people) > 1:
            raise HoigsError(
                f"estimator:mediapipe finds one person, {len(people)} are requested; run it on a "
                "video of each, or use estimator:landmarks-files"
            )
        first = min(video.numbers, default=0)
        count = max(video.numbers, default=-1) + 1 - first
        order, chosen = _order(range(first, first + count), video)
        settings = {"pose": self._settings(), "frames": count, "masks": self.config.masks}
        settings |= {"first": first} if first else {}
        settings |= {"person": chosen} if chosen else {}
        # what other versions of the scripts found is not taken
        settings["scripts"] = [zlib.crc32(path.read_bytes()) for path in (SCRIPT, *IMPORTED)]
        out = video.work / f"mediapipe-{settings_key(settings)}.npz"
        if not out.is_file():
            self._run(self._python(video), out, order, chosen, video, progress)
        with np.load(out, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
        if chosen:  # frames came from the prompt's forwards, then backwards
            inverse = np.argsort(order)
            found |= {k: v[inverse] for k, v in found.items() if k != "size"}
        given = range(first, first + count)
        image, world = (self._spread(found[k], given, video) for k in ("image_xyzv", "world_xyzv"))
        progress(1.0, "landmarks")
        text = f"MediaPipe Pose, complexity {self._complexity()}"
        text += ", of the person clicked on" if chosen else ""
        landmarks = {people[0]: Landmarks(image, world, text)}
        if not self.config.masks:
            return Estimates(landmarks=landmarks)
        person = _frames_of(found["person"], found["size"], first, video)
        text = "MediaPipe's segmentation of selfies and of poses; it takes in what is held"
        text += "; of the person clicked on" if chosen else ""
        notes = _lost(order, image) if chosen else _others(found["several"], image)
        return Estimates(EntityMasks({people[0]: person}, None, text, notes=notes), landmarks)

    def _python(self, video: VideoRequest) -> Path:
        if self.config.python is None:
            return MEDIAPIPE.python()
        # links are not followed: the place of an environment's python, a link, selects it
        python = video.resolve(self.config.python)
        if not python.exists():
            raise HoigsError(f"estimator:mediapipe: there is no {python}; {INSTALL}")
        return python

    def _run(
        self, python: Path, out: Path, order: Sequence[int], chosen: dict[str, Any] | None,
        video: VideoRequest, progress: Progress,
    ) -> None:  # fmt: skip
        out.parent.mkdir(parents=True, exist_ok=True)
        half = out.with_suffix(".part")
        settings = {
            "width": video.width, "height": video.height, "count": len(order), "longest": LONGEST,
            "masks": self.config.masks, "person": chosen, "pose": self._settings(),
            "out": str(half.absolute()),
        }  # fmt: skip
        # -I: the script's own folder, where modules of hoigs lie, is not searched for imports
        argv = [str(python.absolute()), "-I", str(SCRIPT), json.dumps(settings)]
        log = out.with_suffix(".log")
        try:
            run_tool(
                argv, what="estimator:mediapipe", log=log, images=_frames(video, order, progress)
            )
        except HoigsError as error:
            said = log.read_text(errors="replace") if log.is_file() else ""
            if chosen and (nobody := re.search(r"no person is found there: (\d+)", said)):
                raise HoigsError(
                    f"--person: MediaPipe finds no person at the click in frame "
                    f"{order[int(nobody[1])]}; click on the middle of their body (belly or hips), "
                    "in a frame that shows them well, or give a box"
                ) from error
            lacking = "has no mediapipe" in said
            raise HoigsError(f"{error}\n{INSTALL}" if lacking else str(error)) from error
        half.replace(out)

    def _spread(self, rows: np.ndarray, given: range, video: VideoRequest) -> np.ndarray:
        """The rows of the given frames among those of the whole video."""
        if rows.shape != (len(given), 33, 4):
            raise HoigsError(
                f"estimator:mediapipe wrote an array of shape {rows.shape} for {len(given)} "
                "frames; expected 33 landmarks of 4 numbers in each"
            )
        spread = np.full((video.frames, 33, 4), np.nan, np.float32)
        spread[given.start : given.stop] = rows
        return spread


def _others(several: Bool[np.ndarray, " N"], image: Float[np.ndarray, "F 33 4"]) -> tuple[str, ...]:
    """What there is to say if others are seen beside the person who was followed."""
    count = int(several.sum())
    if count < OTHERS * len(several):
        return ()
    i = int(np.flatnonzero(np.isfinite(image[:, HIPS, 0]).all(1))[0])
    x, y = image[i, HIPS, :2].mean(0)
    return (
        f"{count} of {len(several)} frames show several people; the one at {x:.0f},{y:.0f} in "
        f"frame {i} was taken (--person X,Y@FRAME chooses another)",
    )


def _lost(order: Sequence[int], image: Float[np.ndarray, "F 33 4"]) -> tuple[str, ...]:
    """What there is to say if the person clicked on was lost in many of the frames in `order`."""
    seen = np.isfinite(image[order, 0, 0])
    if seen.mean() >= FOLLOWED:
        return ()
    return (
        f"the person clicked on was followed in {int(seen.sum())} of {len(order)} frames; click on "
        f"them in another frame, too, such as {order[int(seen.argmin())]}",
    )


def _order(given: range, video: VideoRequest) -> tuple[list[int], dict[str, Any] | None]:
    """The frames as they are shown, and where among them the person's prompts are: from the first
    prompt's frame forwards, then backwards; without a prompt forwards, and None.

    Raises:
        HoigsError: a prompt is in a frame that is not used.
    """
    person = next((e for e in video.entities if e.kind == "human"), None)
    if person is None or not person.prompts:
        return list(given), None
    for prompt in person.prompts:
        if prompt.frame not in given:
            raise HoigsError(
                f"--person: the click in frame {prompt.frame} is not in a frame that is used; "
                f"these are {given.start} to {given.stop - 1}"
            )
    first = min(p.frame for p in person.prompts)
    order = [*range(first, given.stop), *reversed(range(given.start, first))]
    prompts = [
        [order.index(p.frame), [[q.x, q.y, q.inside] for q in p.points], p.box]
        for p in person.prompts
    ]
    return order, {"prompts": prompts, "back": given.stop - first}


def _frames(video: VideoRequest, order: Sequence[int], progress: Progress) -> Iterator[np.ndarray]:
    """The given frames, reporting progress."""
    for done, i in enumerate(order):
        progress(done / len(order), "landmarks")
        yield video.frame(i)


def _frames_of(bits: np.ndarray, size: np.ndarray, first: int, video: VideoRequest) -> LazyFrames:
    """Masks of the video's size from bits, whose first row is of frame `first`; empty ones of
    frames that were not looked at."""
    width, height = (video.width, video.height)

    def read(i: int) -> Bool[np.ndarray, "H W"]:
        if not 0 <= i - first < len(bits):
            return np.zeros((height, width), dtype=bool)
        mask = np.unpackbits(bits[i - first], axis=1, count=int(size[0])).astype(bool)
        if mask.shape == (height, width):
            return mask
        large = Image.fromarray(mask.astype(np.uint8) * 255)
        return np.asarray(large.resize((width, height), Image.Resampling.BILINEAR)) > 127

    return LazyFrames(video.frames, read)
