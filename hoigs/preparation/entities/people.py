"""The people of a clip: who is followed, their bodies, and what is supposed where nobody is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.body import PELVIS, BodyModel
from hoigs.core.interfaces.estimator import FramePrompt
from hoigs.core.maths.frame_times import Chunking, fill_gaps, smooth
from hoigs.core.reporting import ranges
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.body_files import FileBody
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_values import FitOptions, Joint
from hoigs.preparation.body.landmarks import FrameFates, LandmarkTrack
from hoigs.preparation.body.mask_fit import posed
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.estimates.given import RawLandmarks
from hoigs.preparation.estimates.reader import RawEstimates, UndistortedEstimates
from hoigs.preparation.masks.mask_stack import MaskStack, outlines_of
from hoigs.preparation.options import PrepareOptions, Prompt
from hoigs.preparation.video.frames import Frames

# A clip of objects alone: what the person would have given, supposed instead and named so.

SIZE = 0.3  # metres across, of an object whose size nothing shows
SMOOTHING = 15  # frames
HEIGHT = 0.5  # of the object's distance: how far below a still camera the floor is


@dataclass(frozen=True)
class Nobody:
    """The world of a clip without a person.

    Attributes:
        scene_scale: metres a unit of the cameras' own world.
        depths: of the object along the view, metres.
        ground: y of the floor under a camera that stays in one place, if y points down.
    """

    scene_scale: float
    depths: Float[np.ndarray, " F"]
    ground: float
    provenance: str
    warnings: list[str] = field(default_factory=list)

    def distance(self, cameras: Sequence[Camera]) -> float:
        """Median depth of the object, metres."""
        return float(np.median(self.depths))


def nobody(masks: MaskStack | None, track: CameraTrack, size: float | None) -> Nobody:
    """The world whose unit is the object's size.

    Args:
        masks: of the first object; None, or empty: nothing was found.
        size: of the object across, metres; None: it is supposed.
    """
    across, how = (SIZE, "supposed") if size is None else (size, "given")
    seen = outlines_of(masks) if masks is not None and masks.coverage().any() else None
    known = np.zeros(len(track.cameras), bool) if seen is None else seen.observed & seen.whole
    depths = np.ones(len(track.cameras))
    if seen is not None and known.any():
        focal = np.array([float(camera.K[0, 0]) for camera in track.cameras])
        extent = np.sqrt(np.where(known, seen.areas, 1.0) * 4 / np.pi)
        depths = smooth(fill_gaps(focal * across / extent, known), SMOOTHING)
        if track.static:  # sides that are seen one after another are larger and smaller
            depths = np.full_like(depths, np.median(depths))
    scale = 1.0
    if not track.metric and masks is not None and known.any():
        scale = float(np.median(depths)) / _own_depth(masks, track)
    text = (
        f"nobody: --person none; the object is {how} to be {across:g} m across, which sets the "
        "unit of the world"
    )
    warnings = [] if size is not None else [
        f"nobody is in the clip, so nothing shows its scale: the object is taken to be {SIZE:g} m "
        "across (--set object_size=0.2, if it is), and all distances follow"
    ]  # fmt: skip
    return Nobody(scale, depths, HEIGHT * float(np.median(depths)), text, warnings)


def _own_depth(masks: MaskStack, track: CameraTrack) -> float:
    """How far off the object is in the unit of cameras that measured points: the median depth of
    the points in its masks, or else of all."""
    inside: list[Tensor] = []
    everywhere: list[Tensor] = []
    for mask, camera in zip(masks, track.cameras, strict=True):
        xy, depth = camera.project(track.points)
        seen = camera.shows(xy, depth)
        column, row = xy[seen].long().unbind(-1)
        everywhere.append(depth[seen])
        inside.append(depth[seen][torch.from_numpy(mask)[row, column]])
    chosen = torch.cat(inside)
    return float((chosen if len(chosen) else torch.cat(everywhere)).median())


SEEN, RARELY = 0.3, 0.2  # visibility; share of frames: a part seen in fewer of them is a guess
DOUBTFUL = 0.25  # share of frames: networks see people in clouds and globes now and then
PARTS = {"head": (0, 7, 8), "arms": (13, 14, 15, 16), "legs": (25, 26, 27, 28)}  # landmarks
APART, APART_DEGREES = 0.01, 2.0  # metres: of the same frame in two windows, which then do not meet
STRAY = "they stand alone between frames without any"
OFF_THE_WAY = "beside frames without any, they are off the person's way"
POOR_FIT = 0.02  # of the image's longer side: a fit that misses by more deserves a warning


@dataclass(frozen=True)
class FittedBody:
    """A body in the world, metres.

    Attributes:
        poses: batched over the frames. joints: world.
        scene_scale: metres a unit of the cameras' own world.
        residual_px: mean distance of visible landmarks, median over frames, pixels of the frames.
        residuals: of each frame, NaN without landmarks.
        ground: largest y of the body, median over frames: the floor's height, if y points down.
        found: frames with landmarks; the body of the others is interpolated.
        fates: why the others have none, and what it took to find some.
        report: measures of the fit.
    """

    poses: BodyPose
    joints: Float[Tensor, "F J 3"]
    scene_scale: float
    residual_px: float
    residuals: Float[Tensor, " F"]
    ground: float
    found: Bool[np.ndarray, " F"]
    provenance: str
    report: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    fates: FrameFates = field(default_factory=FrameFates)

    def posed(self, body: BodyModel) -> Iterator[tuple[Tensor, Tensor]]:
        """Vertices and joints, frame by frame."""
        return posed(body, self.poses)

    def distance(self, cameras: Sequence[Camera]) -> float:
        """Median depth of the pelvis, metres."""
        depths = [c.to_camera(p)[2] for c, p in zip(cameras, self.joints[:, PELVIS], strict=True)]
        return float(torch.stack(depths).median())


@dataclass(frozen=True)
class FittedPeople:
    """Everybody's body, by name, the first one's first; in a clip of objects alone, `nobody`."""

    people: dict[str, FittedBody]
    nobody: Nobody | None = None

    @property
    def first(self) -> FittedBody | None:
        return next(iter(self.people.values()), None)

    @property
    def world(self) -> FittedBody | Nobody:
        """What gives the world its unit, its floor and its depth."""
        found = self.first or self.nobody
        assert found is not None  # one of both is made
        return found

    def warnings(self) -> list[str]:
        """Sentences for the report, which name the person where there are several."""
        if self.nobody is not None:
            return self.nobody.warnings
        several = len(self.people) > 1
        return [
            f"{name}: {text}" if several else text
            for name, person in self.people.items()
            for text in person.warnings
        ]


def fit_person(
    landmarks: LandmarkTrack,
    track: CameraTrack,
    body: BodyModel,
    steps: int,
    progress: Callable[[float], None] | None = None,
    source: str = "MediaPipe",
    masks: MaskStack | None = None,
    times: Float[Tensor, " F"] | None = None,
    turns: Float[Tensor, "F 21 3"] | None = None,
    height: float | None = None,
    chunking: Chunking | None = None,
    fates: FrameFates = FrameFates(),  # noqa: B008 - frozen
) -> FittedBody:
    """Fits the body to landmarks, and masks if there are any, in at most `steps`; finds the scale
    of a world that has none.

    Args:
        times: of the frames, seconds.
        turns: axis-angle of the body's joints 1..21, about.
        height: of the person who stands upright, metres; None: the body model's mean.
        chunking: fit window by window.
        fates: what the estimator says of frames without landmarks, and of others.
    """
    given, strays = landmarks, landmarks.strays()
    jumps = landmarks.without(strays).jumps()
    landmarks = landmarks.without(strays | jumps)
    strays |= landmarks.strays()  # single frames between those that jumped
    landmarks = landmarks.without(strays)
    fates = fates.complete(given, {STRAY: strays, OFF_THE_WAY: jumps & ~strays})
    options = FitOptions(scale=not track.metric, steps=steps)
    if height is not None:
        options = replace(options, mean_size=height / stature(body))
    known = None if track.metric else track.points
    fit = fit_body(
        body, landmarks, track.cameras,
        options=options, points=known, masks=masks, times=times, turns=turns,
        chunking=chunking, progress=progress,
    )  # fmt: skip
    # not lists: thousands of small tensors between large ones leave memory in pieces
    joints = torch.empty(len(track.cameras), len(body.parents), 3)
    lowest = torch.empty(len(track.cameras))
    for i, (vertices, at) in enumerate(posed(body, fit.poses)):
        joints[i], lowest[i] = at, vertices[:, 1].max()
    residual = float(fit.residual_px.nanmedian())
    found, solid = int(landmarks.found.sum()), int(landmarks.solid.sum())
    return FittedBody(
        poses=fit.poses,
        joints=joints,
        scene_scale=fit.scene_scale,
        residual_px=residual,
        residuals=fit.residual_px,
        ground=float(lowest.median()),
        found=landmarks.found.numpy(),
        provenance=(
            f"fitted to {source} landmarks{'' if solid else ' in the image only'} of {found} of "
            f"{len(track.cameras)} frames{'' if masks is None else ' and to masks'}, "
            f"{residual:.1f} px off (median of frames); hands are not fitted"
            f"{'' if chunking is None else _windows(fit.joints, chunking)}"
        ),
        report=fit.report,
        warnings=[
            *_warnings(residual, found, solid, track.cameras),
            *_unseen(landmarks),
            *fates_said(fates, len(track.cameras)),
            *_open_joints(fit.joints),
        ],
        fates=fates,
    )


def _windows(joints: Sequence[Joint], chunking: Chunking) -> str:
    """What is said of a fit in windows."""
    if not joints:
        return f"; all frames are in one window of {chunking.chunk}: nothing was split"
    return (
        f"; in {len(joints) + 1} windows of at most {chunking.chunk} frames with one shape, which "
        f"are {1000 * max(j.metres for j in joints):.1f} mm and "
        f"{max(j.degrees for j in joints):.1f} degrees apart at most where they join"
    )


def _open_joints(joints: Sequence[Joint]) -> list[str]:
    """A sentence for the report if windows do not meet, else nothing."""
    apart = [j for j in joints if j.metres > APART or j.degrees > APART_DEGREES]
    if not apart:
        return []
    frames = ", ".join(
        f"{j.frame} ({100 * j.metres:.0f} cm, {j.degrees:.0f} degrees)" for j in apart
    )
    return [
        f"two windows of the fit differ at frames {frames}: landmarks are rare there; use a longer "
        "overlap or chunk"
    ]


def stature(body: BodyModel) -> float:
    """Height of the mean body as it stands, metres."""
    vertices, _ = next(iter(posed(body, BodyPose.zeros(1, betas=body.num_betas))))
    return float(vertices[:, 1].max() - vertices[:, 1].min())


def fates_said(fates: FrameFates, count: int) -> list[str]:
    """Sentences for the report: which of `count` frames were lost or repaired, and why."""
    said = []
    for frames, reasons, what in (
        (fates.lost_frames(), fates.lost, "have no landmarks that are believed; the body follows "
         "their neighbours there, and masks where there are any"),
        (fates.repaired_frames(), fates.repaired, "have landmarks that were not found at once"),
    ):  # fmt: skip
        if frames:
            why = "; ".join(f"{text} in {len(i)} ({ranges(i)})" for text, i in reasons.items())
            said.append(f"{len(frames)} of {count} frames {what}: {why}")
    return said


def _warnings(residual: float, found: int, solid: int, cameras: Sequence[Camera]) -> list[str]:
    warnings = []
    if solid < found:
        warnings.append(
            f"landmarks of {found - solid} of {found} frames are known in the image only: the "
            "depth of limbs is a guess there (estimator:mediapipe sees it)"
        )
    if residual > POOR_FIT * max(cameras[0].width, cameras[0].height):
        warnings.append(f"the body misses its landmarks by {residual:.1f} px: see overlay.mp4")
    return warnings


def _unseen(landmarks: LandmarkTrack) -> list[str]:
    """A sentence for the report if parts of the body are hardly ever seen, else nothing."""
    seen = landmarks.image[landmarks.found][..., 2] > SEEN
    parts = [name for name, marks in PARTS.items() if seen[:, marks].any(1).float().mean() < RARELY]
    if not parts:
        return []
    said = [
        f"the person's {' and '.join(parts)} are out of view or hidden: their pose is not known "
        "and is held relaxed, and the body's height is a guess"
    ]
    if "head" in parts and landmarks.found.float().mean() < DOUBTFUL:
        said.insert(
            0, "few frames show a person, and hardly any a head: is it one? See overlay.mp4"
        )
    return said


# The body of everybody in a clip, one after another, in one world.


def fit_people(
    names: Sequence[str],
    found: UndistortedEstimates,
    raw: RawEstimates,
    track: CameraTrack,
    body: BodyModel,
    options: PrepareOptions,
    video: Frames,
    bodies: FileBody | None,
    progress: Callable[[float], None],
) -> dict[str, FittedBody]:
    """Bodies by name. The first one's gives a world without scale its unit; the others stand in it.

    Args:
        bodies: of another program, of the first person.
    """
    first, *further = names
    times = torch.tensor(video.times)
    assert found.landmarks is not None and raw.landmarks is not None  # somebody is looked for
    share = partial(_share, progress, len(names))
    fitted = fit_person(
        found.landmarks, track, body, options.fit_steps, partial(share, 0), raw.landmarks.source,
        found.masks.persons(found.ball), times,
        None if bodies is None else bodies.rotations(video.indices), options.person_height,
        options.chunking, fates=_of_clip(raw.landmarks, track),
    )  # fmt: skip
    if bodies is not None:
        text = f"{fitted.provenance}; {bodies.used(video.indices)}"
        fitted = replace(fitted, provenance=text)
    people, world = {first: fitted}, _in_metres(track, fitted.scene_scale)
    for k, name in enumerate(further):
        person = found.further[name]
        people[name] = fit_person(
            person.landmarks, world, body, options.fit_steps, partial(share, k + 1),
            raw.further[name].landmarks.source, person.masks, times,
            chunking=options.chunking, fates=_of_clip(raw.further[name].landmarks, track),
        )  # fmt: skip
    return people


def _of_clip(landmarks: RawLandmarks, track: CameraTrack) -> FrameFates:
    """Of the frames that have a camera."""
    fates = landmarks.fates
    return FrameFates.at(fates.lost, fates.repaired, track.positions)


def _share(progress: Callable[[float], None], count: int, number: int, done: float) -> None:
    """The progress of one of several equal works."""
    progress((number + done) / count)


def _in_metres(track: CameraTrack, scale: float) -> CameraTrack:
    if track.metric:
        return track
    cameras = [camera.scaled(scale) for camera in track.cameras]
    return replace(track, cameras=cameras, points=scale * track.points, metric=True)


# Who of several people is followed, where nobody was clicked on: said before the long work.


def chosen_people(
    options: PrepareOptions, found: Sequence[FramePrompt]
) -> tuple[PrepareOptions, str]:
    """Options with prompts of the first one found, or of all, and a sentence that says so; as they
    were, and "", where fewer than two are found."""
    if len(found) < 2:
        return options, ""
    taken = found if options.everybody else found[:1]
    names = [options.human, *(f"{options.human}{k + 2}" for k in range(len(taken) - 1))]
    prompts = {
        name: Prompt(box=at.box, frame=at.frame) for name, at in zip(names, taken, strict=True)
    }
    changed = options.model_copy(
        update={
            "further_people": tuple(names[1:]),
            "prompts": {**options.prompts, **prompts},
        }
    )
    places = ", ".join(_middle(at) for at in found)
    said = f"{len(found)} people are seen in frame {found[0].frame}, at {places}: "
    if options.everybody:
        return changed, said + f"all are fitted, as {', '.join(names)}"
    return changed, said + (
        f"the one at {_middle(found[0])} is fitted (--person X,Y@FRAME chooses another, several "
        "with names, --person anna=X,Y; --person all takes everybody)"
    )


def _middle(at: FramePrompt) -> str:
    assert at.box is not None
    x0, y0, x1, y1 = at.box
    return f"{(x0 + x1) / 2:.0f},{(y0 + y1) / 2:.0f}"
