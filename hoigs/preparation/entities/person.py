"""The person: the body fitted to landmarks and masks, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.diagnostics import ranges
from hoigs.core.interfaces.body import PELVIS, BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.core.windows import Chunking
from hoigs.preparation.body.fit import fit_body
from hoigs.preparation.body.fit_values import FitOptions, Joint
from hoigs.preparation.body.landmarks import FrameFates, LandmarkTrack
from hoigs.preparation.body.silhouette import posed
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.entities.nobody import Nobody
from hoigs.preparation.masks.mask_stack import MaskStack

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
