"""The people of a clip: who is followed, their bodies, and what is supposed where nobody is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_problem import FitOptions, Observations
from hoigs.preparation.body.fitted import BodyErrors, Joint
from hoigs.preparation.body.landmarks import FrameFates, Landmarks
from hoigs.preparation.body.mask_fit import posed
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.mask_stack import MaskStack, outlines_of
from hoigs.preparation.options import PrepareOptions

# A clip of objects alone: what the person would have given, supposed instead and named so.

SIZE = 0.3  # metres across, of an object whose size nothing shows
SMOOTHING = 15  # frames
HEIGHT = 0.5  # of the object's distance: how far below a still camera the floor is


@dataclass(frozen=True)
class Unit:
    """What turns the unit of the cameras' own world into metres.

    Attributes:
        metres: of one unit.
        ground: y of the floor, if y points down: the largest of the first person's body, median
            over frames.
        distance: median depth of the first person's pelvis, or of the object, metres.
        depths: in a clip of objects alone, of the first object along the view, metres.
    """

    metres: float
    ground: float
    distance: float
    depths: Float[np.ndarray, " F"] | None = None


def unit_of_object(
    masks: MaskStack | None, track: CameraTrack, size: float | None
) -> tuple[Unit, str, list[str]]:
    """The world whose unit is the object's size, what it was made from, and warnings.

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
    distance = float(np.median(depths))
    return Unit(scale, HEIGHT * distance, distance, depths), text, warnings


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
class Body:
    """A body in the world, metres.

    Attributes:
        poses: batched over the frames. joints: world.
        scene_scale: metres a unit of the cameras' own world.
        residual_px: mean distance of visible landmarks, median over frames, pixels of the frames.
        residuals: of each frame, NaN without landmarks.
        ground: largest y of the body, median over frames: the floor's height, if y points down.
        found: frames with landmarks; the body of the others is interpolated.
        fates: why the others have none, and what it took to find some.
        errors: within which the body is.
        unseen: parts of it that are hardly ever seen.
        report: measures of the fit.
    """

    poses: BodyPose
    joints: Float[Tensor, "F J 3"]
    scene_scale: float
    residual_px: float
    residuals: Float[Tensor, " F"]
    ground: float
    found: Bool[np.ndarray, " F"]
    errors: BodyErrors
    unseen: list[str]
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


def people_warnings(bodies: Mapping[str, Body]) -> list[str]:
    """Sentences for the report, which name the person where there are several."""
    return [
        f"{name}: {text}" if len(bodies) > 1 else text
        for name, person in bodies.items()
        for text in person.warnings
    ]


def fit_person(
    seen: Observations,
    body: BodyModel,
    options: FitOptions,
    chunking: Chunking | None = None,
    progress: Callable[[float], None] | None = None,
) -> Body:
    """Fits the body to landmarks that are believed, and masks if there are any; finds the scale of
    a world that has none.

    Args:
        chunking: fit window by window.
    """
    given, strays = seen.landmarks, seen.landmarks.strays()
    jumps = given.without(strays).jumps()
    landmarks = given.without(strays | jumps)
    strays |= landmarks.strays()  # single frames between those that jumped
    landmarks = landmarks.without(strays)
    fates = given.fates.complete(given, {STRAY: strays, OFF_THE_WAY: jumps & ~strays})
    fit = fit_body(body, replace(seen, landmarks=landmarks), options, chunking, progress)
    cameras = seen.cameras
    # not lists: thousands of small tensors between large ones leave memory in pieces
    joints = torch.empty(len(cameras), len(body.parents), 3)
    lowest = torch.empty(len(cameras))
    for i, (vertices, at) in enumerate(posed(body, fit.poses)):
        joints[i], lowest[i] = at, vertices[:, 1].max()
    residual = float(fit.residual_px.nanmedian())
    unseen = unseen_parts(landmarks)
    found, solid = int(landmarks.found.sum()), int(landmarks.solid.sum())
    return Body(
        poses=fit.poses,
        joints=joints,
        scene_scale=fit.scene_scale,
        residual_px=residual,
        residuals=fit.residual_px,
        ground=float(lowest.median()),
        found=landmarks.found.numpy(),
        errors=fit.errors,
        unseen=unseen,
        provenance=(
            f"fitted to {landmarks.source} landmarks{'' if solid else ' in the image only'} of "
            f"{found} of {len(cameras)} frames{'' if seen.masks is None else ' and to masks'}, "
            f"{residual:.1f} px off (median of frames); {_size(fit.report, stature(body))}; "
            f"{_within(fit.errors)}; hands are not fitted"
            f"{'' if chunking is None else _windows(fit.joints, chunking)}"
        ),
        report=fit.report,
        warnings=[
            *_warnings(residual, found, solid, cameras),
            *_unseen(unseen, landmarks),
            *fates_said(fates, len(cameras)),
            *_open_joints(fit.joints),
        ],
        fates=fates,
    )


def _size(report: Mapping[str, Any], mean: float) -> str:
    """What is said of a body's size.

    Args:
        mean: height of the mean body, metres.
    """
    size, error = report["size"], 200 * report["size_spread"]
    return (
        f"its size, that of {mean * size:.2f} m of height, is {report['size_from']}, and right to "
        f"{error:.0f} % in 19 of 20 cases, as is the distance that follows from it"
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


def _within(errors: BodyErrors) -> str:
    off = float(errors.joints.nanmedian())
    if math.isnan(off):
        return "how far its joints are off is not known"
    return f"its joints about the shoulders are right to {1000 * off:.0f} mm in four of five frames"


def unseen_parts(landmarks: Landmarks) -> list[str]:
    """Parts of the body that are hardly ever seen."""
    seen = landmarks.image[landmarks.found][..., 2] > SEEN
    return [name for name, marks in PARTS.items() if seen[:, marks].any(1).float().mean() < RARELY]


def _unseen(parts: list[str], landmarks: Landmarks) -> list[str]:
    """A sentence for the report if parts of the body are hardly ever seen, else nothing."""
    if not parts:
        return []
    said = [
        f"the person's {' and '.join(parts)} are out of view or hidden: their pose is not known "
        "and is held relaxed"
    ]
    if "head" in parts and landmarks.found.float().mean() < DOUBTFUL:
        said.insert(
            0, "few frames show a person, and hardly any a head: is it one? See overlay.mp4"
        )
    return said


# The body of everybody in a clip, one after another, in one world.


def fit_people(
    people: Mapping[str, Observations],
    track: CameraTrack,
    body: BodyModel,
    options: PrepareOptions,
    progress: Callable[[float], None],
) -> tuple[dict[str, Body], Unit]:
    """Bodies by name, and the unit of a world without scale, which is the first one's; the others
    stand in it.

    Args:
        people: as the cameras of `track` see them, the first one's first.
    """
    bodies: dict[str, Body] = {}
    known = FitOptions(steps=options.fit_steps)
    scale = 1.0
    for number, (name, seen) in enumerate(people.items()):
        settings = known
        if number == 0:
            settings = replace(known, scale=not track.metric)
            if options.person_height is not None:
                settings = replace(settings, mean_size=options.person_height / stature(body))
        placed = replace(seen, cameras=[camera.scaled(scale) for camera in seen.cameras])
        bodies[name] = fit_person(
            placed, body, settings, options.chunking, partial(_share, progress, len(people), number)
        )
        if number == 0:
            scale = bodies[name].scene_scale
    first = next(iter(bodies.values()))
    distance = first.distance([camera.scaled(scale) for camera in track.cameras])
    return bodies, Unit(scale, first.ground, distance)


def _share(progress: Callable[[float], None], count: int, number: int, done: float) -> None:
    """The progress of one of several equal works."""
    progress((number + done) / count)


# Who of several people is followed, where nobody was clicked on: said before the long work.


SMALL = 0.5  # of the picture's height: a smaller person is followed by the box about them
BESIDE = 3  # people are followed besides those who are fitted, which takes as long for each


def chosen_people(
    options: PrepareOptions, found: Sequence[FramePrompt], height: int
) -> tuple[dict[str, FramePrompt], dict[str, FramePrompt], str]:
    """The first one found, or all, by name; those who are not chosen, likewise; and a sentence that
    says so. Nobody, and "", where one is found who is as large as most, and whom any look at the
    whole picture finds.

    Args:
        height: of the picture, pixels.
    """
    if not found:
        return {}, {}, ""
    if len(found) == 1:
        at, share = found[0], _tall(found[0]) / height
        if share > SMALL:
            return {}, {}, ""
        said = (
            f"the person seen in frame {at.frame}, at {_middle(at)}, is small (about "
            f"{100 * share:.0f} % of the picture's height) and followed from there (--person "
            "X,Y@FRAME chooses another); limbs of people so small are known less well"
        )
        return {options.human_name: at}, {}, said
    names = [options.human_name, *(f"{options.human_name}{k + 2}" for k in range(len(found) - 1))]
    boxes = dict(zip(names, found, strict=True))
    places = ", ".join(_middle(at) for at in found)
    said = f"{len(found)} people are seen in frame {found[0].frame}, at {places}: "
    if options.everybody:
        return boxes, {}, said + f"all are fitted, as {', '.join(names)}"
    chosen = {names[0]: boxes.pop(names[0])}
    beside = dict(list(boxes.items())[:BESIDE])
    said += (
        f"the one at {_middle(found[0])} is fitted (--person X,Y@FRAME chooses another, several "
        "with names, --person anna=X,Y; --person all takes everybody); what others cover is left "
        "out of training and scores, and is no object"
    )
    return chosen, beside, said


def _tall(at: FramePrompt) -> float:
    assert at.box is not None
    return at.box[3] - at.box[1]


def _middle(at: FramePrompt) -> str:
    assert at.box is not None
    x0, y0, x1, y1 = at.box
    return f"{(x0 + x1) / 2:.0f},{(y0 + y1) / 2:.0f}"
