"""estimator:mediapipe: MediaPipe's landmarks and masks of a person, in an environment of its own.

mediapipe 0.10.21, the last wheel that contains its models, needs numpy below 2, which hoigs does
not. So `mediapipe_script.py` is run by the Python of an environment that hoigs makes, or that the
user names; it reads frames from standard input and writes one file.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    EstimateKind,
    Estimates,
    Estimator,
    FramePrompt,
    Landmarks,
    LazyFrames,
    PromptError,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress, ranges
from hoigs.core.system.files import written_whole
from hoigs.plugins.estimators import steady_masks
from hoigs.plugins.estimators.mediapipe import one_person
from hoigs.plugins.estimators.mediapipe.mediapipe_doubts import GONE, LOST, REPAIRED
from hoigs.plugins.estimators.tools import HEAVY, MEDIAPIPE, run_tool, settings_key

# Masks of people from the bits that `mediapipe_script.py` wrote.


def steadied(
    out: Path,
    person: UInt8[np.ndarray, "P N h B"],
    size: Int[np.ndarray, "2"],
    frames: Iterable[UInt8[np.ndarray, "H W 3"]],
    video: VideoRequest,
) -> tuple[UInt8[np.ndarray, "P N h B"], bool, Bool[np.ndarray, "P N"]]:
    """The bits of masks that agree where the camera stands still, whether it does, and which masks
    were changed for it.

    Args:
        out: file of what MediaPipe found; the result is kept beside it.
        size: width and height of the masks. frames: those of the masks, read only if needed.
    """
    scripts = (Path(steady_masks.__file__), Path(one_person.__file__), Path(__file__))
    key = zlib.crc32(b"".join(path.read_bytes() for path in scripts))
    kept = out.with_name(f"{out.stem}-steady-{key:08x}.npz")
    if not kept.is_file():
        bits = person.copy()
        people = [_masks(rows, int(size[0])) for rows in person]
        steady = steady_masks.SteadyMasks(people, frames, (video.width, video.height))
        if steady.still:
            for k, i in np.ndindex(*bits.shape[:2]):
                bits[k, i] = np.packbits(steady.mask(k, i), axis=1)
        with written_whole(kept) as part, part.open("wb") as file:
            np.savez_compressed(file, person=bits, still=steady.still)
    with np.load(kept, allow_pickle=False) as file:
        bits = file["person"]
        return bits, bool(file["still"]), (bits != person).any((2, 3))


def frames_of(
    bits: UInt8[np.ndarray, "N h B"], size: Int[np.ndarray, "2"], first: int, video: VideoRequest
) -> LazyFrames:
    """Masks of the video's size from bits, whose first row is of frame `first`; empty ones of
    frames that were not looked at."""
    width, height = (video.width, video.height)

    def read(i: int) -> Bool[np.ndarray, "H W"]:
        if not 0 <= i - first < len(bits):
            return np.zeros((height, width), dtype=bool)
        mask = _mask(bits[i - first], int(size[0]))
        if mask.shape == (height, width):
            return mask
        large = Image.fromarray(mask.astype(np.uint8) * 255)
        return np.asarray(large.resize((width, height), Image.Resampling.BILINEAR)) > 127

    return LazyFrames(video.frames, read)


def _masks(bits: UInt8[np.ndarray, "N h B"], width: int) -> LazyFrames:
    return LazyFrames(len(bits), lambda i: _mask(bits[i], width))


def _mask(rows: UInt8[np.ndarray, "h B"], width: int) -> Bool[np.ndarray, "h w"]:
    return np.unpackbits(rows, axis=1, count=width).astype(bool)


SCRIPT = Path(__file__).with_name("mediapipe_script.py")
PARTS = ("doubts", "check", "guided", "chosen", "people", "look")
IMPORTED = [SCRIPT.with_name(f"mediapipe_{part}.py") for part in PARTS]
INSTALL = "run `hoigs estimators install mediapipe` and leave `python` out"
OTHERS, FOLLOWED = 0.1, 0.8  # shares of the frames, above and below which there is something to say
LOOKS = 7  # frames that are looked at for several people, less one
CERTAIN = 0.75  # of these, that show the same person where a way through all frames leads
HERE = 0.25  # of the side of the square about somebody: their hips are the same
HIPS = [23, 24]  # of the 33 landmarks
SMALL = 0.6  # of the image's height: side of the square about a person, believed if seen twice
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
    """Landmarks and mask of a person, or of all who are clicked on, by MediaPipe in one pass.

    It follows a person from frame to frame and loses one that jumps, so it is given every frame
    from the first wanted one to the last: by the square about those who are clicked on, or whom
    most of a few looks show; else by MediaPipe's detector. Where that finds no landmarks it looks
    again with a border above the frame, and landmarks that are not on the pose's own mask are
    dropped, with the reason. That mask is the person's; along its outline the segmentations of the
    frame and of the person's part of it have a say.
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
        given = range(min(video.numbers, default=0), max(video.numbers, default=-1) + 1)
        order, chosen = _order(given, video)
        clicked = chosen is not None
        looked = None if clicked else self._by_looks(video, given, progress)
        out, found = looked or self._found(order, chosen, video, given, progress)
        led_away: tuple[str, ...] = ()
        if not clicked and not looked:
            out, found, led_away = self._of_one(out, found, video, given, progress)
        progress(1.0, "landmarks")
        text = f"MediaPipe Pose, complexity {self._complexity()}"
        text += ", of whoever was chosen" if clicked else ""
        landmarks = {}
        for k, name in enumerate(people):
            image = self._spread(found["image_xyzv"][k], given, video)
            world = self._spread(found["world_xyzv"][k], given, video)
            fate = self._fate(found["fate"][k], given)
            landmarks[name] = Landmarks(
                image, world, text, lost=_frames_by(fate, LOST),
                repaired=_frames_by(fate, REPAIRED), to_hips=True,
            )  # fmt: skip
        if not self.config.masks:
            return Estimates(landmarks=landmarks)
        frames = _frames(video, given, progress, "masks")
        persons, still, changed = steadied(out, found["person"], found["size"], frames, video)
        masks = {
            name: frames_of(persons[k], found["size"], given.start, video)
            for k, name in enumerate(people)
        }
        text = "MediaPipe's segmentation of poses, its outline refined by that of selfies"
        text += "; the same wherever frames of the still camera are" if still else ""
        text += "; of whoever was chosen" if clicked else ""
        images = {name: track.image_xyzv for name, track in landmarks.items()}
        notes = _lost(given, images) if clicked else _others(found["several"], images[people[0]])
        if not clicked:
            empty = ~found["person"][0].any((1, 2))
            notes += _without_pose(found["alone"], empty, given, video.numbers)
        notes += led_away + _changed(np.atleast_1d(changed.any(0)), given, video.numbers)
        return Estimates(EntityMasks(masks, None, text, notes=notes), landmarks)

    def _found(
        self, order: Sequence[int], chosen: dict[str, Any] | None, video: VideoRequest,
        given: range, progress: Progress,
    ) -> tuple[Path, dict[str, np.ndarray]]:  # fmt: skip
        """The script's file, and what is in it."""
        settings = {"pose": self._settings(), "frames": len(given), "masks": self.config.masks}
        settings |= {"first": given.start} if given.start else {}
        settings |= {"people": chosen} if chosen else {}
        # what other versions of the scripts found is not taken
        settings["scripts"] = [zlib.crc32(path.read_bytes()) for path in (SCRIPT, *IMPORTED)]
        out = video.work / f"mediapipe-{settings_key(settings)}.npz"
        if not out.is_file():
            self._run(self._python(video), out, order, chosen, video, progress)
        with np.load(out, allow_pickle=False) as file:
            return out, {name: file[name] for name in file.files}

    def _by_looks(
        self, video: VideoRequest, given: range, progress: Progress
    ) -> tuple[Path, dict[str, np.ndarray]] | None:
        """What is found by following the square about the person whom most looks show: nearer to
        the truth than the detector's way from frame to frame, which smooths and so lags. None where
        few looks show anybody, or several people, or they are not where the way leads."""
        rows, shown = self._looks(video)
        seen = _together(rows, shown, video)
        if len(seen) != 1 or len(set(rows[:, 0])) < CERTAIN * len(shown):
            return None
        human = EntityRequest("human", "human", box=seen[0].box, frame=seen[0].frame)
        order, chosen = _order(given, replace(video, entities=(human,)))
        try:
            out, found = self._found(order, chosen, video, given, progress)
        except PromptError:
            return None  # nobody is found again in the square
        image = self._spread(found["image_xyzv"][0], given, video)
        if np.isfinite(image[given, 0, 0]).mean() < FOLLOWED:
            return None
        there = [
            np.linalg.norm(image[shown[int(place)], HIPS, :2].mean(0) - (x, y)) < HERE * side
            for place, _, x, y, side in rows.tolist()
        ]
        return (out, found) if np.mean(there) >= CERTAIN else None

    def _of_one(
        self, out: Path, found: dict[str, np.ndarray], video: VideoRequest, given: range,
        progress: Progress,
    ) -> tuple[Path, dict[str, np.ndarray], tuple[str, ...]]:  # fmt: skip
        """What was found of the person whom most frames show, where MediaPipe's own way led to
        others: they are followed as if they had been clicked on; if that shows less of them, the
        frames of others are left out. And what there is to say of it."""
        image = found["image_xyzv"][0]
        other = one_person.someone_else(image)
        if not other.any():
            return out, found, ()
        own = np.flatnonzero(np.isfinite(image[:, 0, 0]) & ~other)
        i = int(own[len(own) // 2])
        low, high = image[i, :, :2].min(0), image[i, :, :2].max(0)
        box = (*low.clip(0).tolist(), *high.clip(max=(video.width, video.height)).tolist())
        human = EntityRequest("human", "human", box=box, frame=given[i])
        x, y = image[i, HIPS, :2].mean(0)
        said = (
            f"MediaPipe went over to other people in {int(other.sum())} of {len(given)} frames; "
            f"the one at {x:.0f},{y:.0f} in frame {given[i]}, whom most frames show, was followed "
            "(--person X,Y@FRAME chooses another)",
        )
        order, chosen = _order(given, replace(video, entities=(human,)))
        try:
            again, followed = self._found(order, chosen, video, given, progress)
        except PromptError:
            followed = found
        seen = np.isfinite(followed["image_xyzv"][0][:, 0, 0])
        if followed is not found and seen[own].mean() >= FOLLOWED:
            return again, followed, said
        for name, nothing in (("image_xyzv", np.nan), ("world_xyzv", np.nan), ("person", 0)):
            if name in found:  # masks are not always asked for
                found[name][0][other] = nothing
        found["fate"][0][other] = GONE
        return out, found, said

    def people(self, video: VideoRequest) -> tuple[FramePrompt, ...]:
        rows, shown = self._looks(video)
        return _together(rows, shown, video)

    def _looks(self, video: VideoRequest) -> tuple[Float[np.ndarray, "N 5"], list[int]]:
        """Who is seen in a few frames, as `mediapipe_script.Lookout` has it, and which they are."""
        numbers = video.numbers
        shown = sorted({numbers[i * (len(numbers) - 1) // LOOKS] for i in range(LOOKS + 1)})
        settings = {"pose": self._settings(), "look": shown}
        settings["scripts"] = [zlib.crc32(path.read_bytes()) for path in (SCRIPT, *IMPORTED)]
        out = video.work / f"people-{settings_key(settings)}.npz"
        if not out.is_file():
            self._run(self._python(video), out, shown, None, video, no_progress, look=True)
        with np.load(out, allow_pickle=False) as file:
            return file["people"], shown

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
        video: VideoRequest, progress: Progress, look: bool = False,
    ) -> None:  # fmt: skip
        out.parent.mkdir(parents=True, exist_ok=True)
        half = out.with_suffix(".part")
        settings = {
            "width": video.width, "height": video.height, "count": len(order), "longest": LONGEST,
            "masks": self.config.masks, "people": chosen, "pose": self._settings(),
            "out": str(half.absolute()), "look": look,
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
            if chosen and (why := _misplaced(said)):
                raise PromptError(why) from error
            lacking = "has no mediapipe" in said
            raise HoigsError(f"{error}\n{INSTALL}" if lacking else str(error)) from error
        half.replace(out)

    @staticmethod
    def _fate(rows: np.ndarray, given: range) -> Mapping[int, int]:
        """What became of each frame that was looked at, by its number."""
        if rows.shape != (len(given),):
            raise HoigsError(
                f"estimator:mediapipe wrote what became of {rows.shape} frames, expected "
                f"({len(given)},)"
            )
        return dict(zip(given, rows.tolist(), strict=True))

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


def _together(
    rows: Float[np.ndarray, "N 5"], shown: Sequence[int], video: VideoRequest
) -> tuple[FramePrompt, ...]:
    """Everybody in the frame that shows most people, the surest first."""
    small = rows[:, 4] < SMALL * video.height
    if len(set(rows[small, 0])) < min(2, len(shown)):  # so small, a bush may be taken for somebody
        rows = rows[~small]
    if not len(rows):
        return ()
    places = rows[:, 0].astype(int)
    counts = np.bincount(places)
    # what is seen once only may be a coat on a chair
    counts[counts > 1] = 1 if (counts > 1).sum() < min(2, len(shown)) else counts[counts > 1]
    place = int(np.lexsort((np.bincount(places, rows[:, 1]), counts))[-1])
    here = rows[places == place]
    here = here[np.argsort(-here[:, 1])][: counts[place]]
    prompts = []
    for _, _, x, y, side in here.tolist():
        half, limits = side / 2 / 1.25, (video.width, video.height)
        low = [max(0.0, v - half) for v in (x, y)]
        high = [min(float(most), v + half) for v, most in zip((x, y), limits, strict=True)]
        prompts.append(FramePrompt(shown[place], (), (*low, *high)))
    return tuple(prompts)


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


def _misplaced(log: str) -> str:
    """What the script has against a click, "" if nothing."""
    if nobody := re.search(r"no person is found there: (\d+) of (.*)", log):
        return (
            f"--person: MediaPipe finds no person at the click in frame {nobody[1]} ({nobody[2]}); "
            "click on the middle of their body (belly or hips), in a frame that shows them well, "
            "or give a box; if clicks of this frame are on two people, name them: --person "
            "anna=300,200"
        )
    if other := re.search(r"someone else is there: (\d+) of (.*)", log):
        return (
            f"--person: the click in frame {other[1]} is on someone else than the person followed "
            f"from the first click ({other[2]}); to fit both, name the other: --person "
            f"anna=X,Y@{other[1]}"
        )
    return ""


def _frames_by(fate: Mapping[int, int], words: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """The frames of each fate that there are words for."""
    return {
        text: frames
        for code, text in words.items()
        if (frames := tuple(i for i, one in fate.items() if one == code))
    }


def _without_pose(
    lost: Bool[np.ndarray, " N"], empty: Bool[np.ndarray, " N"], given: range,
    wanted: Sequence[int],
) -> tuple[str, ...]:  # fmt: skip
    """What there is to say of masks of frames in which no pose was found."""
    notes = []
    for which, text in (
        (lost & ~empty, "are of the segmentation of selfies alone, which may lack limbs or take "
         "furniture in: no pose was found"),
        (lost & empty, "are empty: neither a pose nor a person was found"),
    ):  # fmt: skip
        if frames := _wanted(which, given, wanted):
            notes.append(f"the person's masks of {len(frames)} frames ({ranges(frames)}) {text}")
    return tuple(notes)


def _changed(which: Bool[np.ndarray, " N"], given: range, wanted: Sequence[int]) -> tuple[str, ...]:
    frames = _wanted(which, given, wanted)
    if not frames:
        return ()
    return (
        f"parts of the person's masks of {len(frames)} frames ({ranges(frames)}) were changed to "
        "what most frames show that look alike there",
    )


def _wanted(which: Bool[np.ndarray, " N"], given: range, wanted: Sequence[int]) -> list[int]:
    return sorted({given[i] for i in np.flatnonzero(which).tolist()} & set(wanted))


def _lost(given: range, images: Mapping[str, Float[np.ndarray, "F 33 4"]]) -> tuple[str, ...]:
    """What there is to say of those clicked on who were lost in many of the frames."""
    notes = []
    for name, image in images.items():
        seen = np.isfinite(image[given, 0, 0])
        if seen.mean() < FOLLOWED:
            who = "the person chosen" if len(images) == 1 else name
            notes.append(
                f"{who} was followed in {int(seen.sum())} of {len(given)} frames; click on them in "
                f"another frame, too, such as {given[int(seen.argmin())]}"
            )
    return tuple(notes)


def _order(given: range, video: VideoRequest) -> tuple[list[int], dict[str, Any] | None]:
    """The frames as they are shown, and people's prompts: the first one's frame of each of several,
    from the first of these forwards, then from the last of them backwards. Without a prompt
    forwards, and None.

    Raises:
        HoigsError: a prompt is in a frame that is not used, or one of several people has none.
    """
    people = [e for e in video.entities if e.kind == "human"]
    without = [e.name for e in people if not e.prompts]
    if not people or (len(people) == 1 and without):
        return list(given), None
    if without:
        raise HoigsError(
            f"estimator:mediapipe: {len(people)} people are requested, and nothing says who "
            f"{' and '.join(without)} is: click on each, such as --person {without[0]}=320,210"
        )
    for prompt in (p for e in people for p in e.prompts):
        if prompt.frame not in given:
            raise HoigsError(
                f"--person: the click in frame {prompt.frame} is not in a frame that is used; "
                f"these are {given.start} to {given.stop - 1}"
            )
    begins = [e.prompts[0].frame for e in people]
    shown = sorted(set(begins)) if len(begins) > 1 else []
    order = [*shown, *range(min(begins), given.stop), *reversed(range(given.start, max(begins)))]
    prompts = {
        e.name: [[p.frame, [[q.x, q.y, q.inside] for q in p.points], p.box] for p in e.prompts]
        for e in people
    }
    back = len(shown) + given.stop - min(begins)
    return order, {"prompts": prompts, "order": order, "back": back, "shown": len(shown)}


def _frames(
    video: VideoRequest, order: Sequence[int], progress: Progress, what: str = "landmarks"
) -> Iterator[np.ndarray]:
    """The given frames, reporting progress."""
    for done, i in enumerate(order):
        progress(done / len(order), what)
        yield video.frame(i)
