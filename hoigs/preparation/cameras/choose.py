"""Which cameras a video gets: COLMAP's, one that stands still, or those of its own SfM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hoigs.core.reporting import ranges
from hoigs.core.system.colmap_files import choice_told
from hoigs.core.system.npz import holds
from hoigs.core.values.lens import Lens
from hoigs.preparation.body.body_files import FileBody
from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.cameras.calibration import fitting, given_intrinsics, read_calibration
from hoigs.preparation.cameras.camera_track import (
    CameraTrack,
    colmap_cameras,
    pinhole,
    static_cameras,
)
from hoigs.preparation.cameras.focal import static_focal
from hoigs.preparation.cameras.known import given_cameras, megasam_cameras, vggt_cameras
from hoigs.preparation.cameras.sfm import structure_from_motion
from hoigs.preparation.cameras.turning_cameras import (
    NEAR,
    PIXELS,
    BackgroundMotion,
    background_motion,
    turning_cameras,
)
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import MEGASAM, VGGT, SourceError


@dataclass(frozen=True)
class ChosenCameras:
    """Cameras, and warnings."""

    track: CameraTrack
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class BesideVideo:
    """What lies beside a video and says something of its cameras.

    Attributes:
        model: a COLMAP model. cameras: cameras.npz, or MegaSaM's or VGGT's npz.
        bodies: whose lens a still camera has, unless another is given.
    """

    model: Path | None = None
    cameras: Path | None = None
    bodies: FileBody | None = None


def choose_cameras(
    video: Frames,
    landmarks: Landmarks | None,
    masks: GivenMasks,
    beside: BesideVideo,
    options: PrepareOptions,
    folder: Path,
    progress: Callable[[float], None],
) -> ChosenCameras:
    """Cameras as `options.camera` requests them.

    Args:
        landmarks, masks: of the raw frames; landmarks None: nobody is looked for.
        folder: to work in; it may be removed when the result has been kept.

    Raises:
        SourceError: the model does not fit, or structure from motion fails.
    """
    lens = known_lens(options, video)
    model, given, bodies = beside.model, beside.cameras, beside.bodies
    made = None if options.own_cameras else given or model
    if lens is not None and made is not None:
        raise SourceError(
            f"{made.name} beside the video has a lens already: leave {lens[1]} out, or use "
            "--camera sfm, static or turning to make the cameras anew"
        )
    if not options.own_cameras and given is not None:
        read = given_cameras
        for arrays, reader in ((MEGASAM, megasam_cameras), (VGGT, vggt_cameras)):
            read = reader if holds(given, arrays) else read
        return ChosenCameras(read(video, given))
    if not options.own_cameras and model is not None:
        sparse = model if model.name == "sparse" else model.parent
        told = choice_told(sparse, model)
        return ChosenCameras(colmap_cameras(video, model), warnings=[told] if told else [])
    if options.camera in {"auto", "static", "turning"}:
        still_lens = lens
        if lens is None and options.focal is None and bodies is not None:
            still_lens = bodies.lens(video.native_width, video.native_height)
        motion = None if options.camera == "turning" else background_motion(video, masks)
        if motion is not None and (options.camera == "static" or motion.static):
            return _static(video, landmarks, options, still_lens, motion)
        if motion is None or motion.turned is not None:
            return _turning(video, landmarks, masks, options, still_lens, motion, progress)
    return _from_motion(video, masks, options, lens, folder, progress)


COVERED = 0.6  # of the image, by a mask of the person


def covered_frames(landmarks: Landmarks | None, masks: GivenMasks) -> list[int]:
    """Frames in which the person's mask covers most of the image and no landmarks of a body were
    found, as where a hand covers the lens: they show neither the person nor the scene. None if
    these are half of the frames or more, as the video is a close-up then."""
    people = masks.persons(None)
    if people is None or landmarks is None:
        return []
    covered = (people.coverage() > COVERED) & ~landmarks.found.numpy()
    return np.flatnonzero(covered).tolist() if covered.mean() < 0.5 else []


def without_covered(
    chosen: ChosenCameras, landmarks: Landmarks | None, masks: GivenMasks
) -> ChosenCameras:
    """Cameras without those of `covered_frames`, and a warning that names these."""
    covered = [i for i in covered_frames(landmarks, masks) if i in chosen.track.positions]
    if len(covered) in (0, len(chosen.track.positions)):
        return chosen
    said = (
        f"{len(covered)} frames ({ranges(covered)}) are left out: the person's mask covers most of "
        "the image there and no body was found, as where a hand covers the lens"
    )
    return ChosenCameras(chosen.track.without(covered), [*chosen.warnings, said])


def _turning(
    video: Frames, landmarks: Landmarks | None, masks: GivenMasks, options: PrepareOptions,
    lens: tuple[Lens, str] | None, motion: BackgroundMotion | None,
    progress: Callable[[float], None],
) -> ChosenCameras:  # fmt: skip
    focal = static_focal(video, landmarks, options.focal)
    track, turns = turning_cameras(video, masks, lens, focal, progress)
    warnings = []
    if lens is None and not turns.spread:
        warnings = [*focal.warnings]
        track = replace(track, figures=focal.figures | track.figures)
    if motion is not None and motion.parallax > NEAR:
        warnings.append(
            f"{_turns(motion)}; it also changes its place, by too little to measure: its turns "
            f"leave {motion.parallax:.1f} px, by which near parts of the scene are blurred "
            "(--camera moving tries to find its way)"
        )
    if turns.lost:
        warnings.append(
            f"the camera turns, and the background of {len(turns.lost)} frames "
            f"({ranges(turns.lost)}) was not found again: their cameras lie between the others'"
        )
    return ChosenCameras(track, warnings=warnings)


def _turns(motion: BackgroundMotion) -> str:
    return (
        f"the camera turns (by {motion.turns:.1f} degrees between two of the compared "
        f"frames; the background moves by up to {motion.largest:.0f} px {PIXELS})"
    )


def known_lens(options: PrepareOptions, video: Frames) -> tuple[Lens, str] | None:
    """The lens that `options.intrinsics` or `calibration` gives, at the video's own size, and
    which of them.

    Raises:
        SourceError: the file cannot be read, or the lens does not fit the video.
    """
    size = (video.native_width, video.native_height)
    if options.intrinsics is not None:
        how = "--intrinsics"
        return fitting(given_intrinsics(options.intrinsics, size), size, how), how
    if options.calibration is None:
        return None
    lens, what = read_calibration(options.calibration, size)
    return fitting(lens, size, f"--calibration {what}"), f"--calibration {what}"


def _static(
    video: Frames,
    landmarks: Landmarks | None,
    options: PrepareOptions,
    lens: tuple[Lens, str] | None,
    motion: BackgroundMotion,
) -> ChosenCameras:
    figures, warnings, how = {}, _doubts(motion, options.camera == "static"), ""
    if motion.known:
        figures = {"displacement_px": round(motion.largest, 3)}
        how = f"; features outside the masks move by up to {motion.largest:.2f} px {PIXELS}"
    if lens is not None:
        track = static_cameras(video, *lens)
    else:
        found = static_focal(video, landmarks, options.focal)
        track = static_cameras(video, pinhole(video, found.pixels), found.how)
        figures |= found.figures
        warnings += found.warnings
    if motion.still is not None:
        first, last = motion.still
        moved = [i for i in range(len(video)) if not first <= i <= last]
        said = (
            f"the camera stands still in frames {first}-{last} alone: the background of the "
            f"{len(moved)} others ({ranges(moved)}) has moved or is hidden"
        )
        if options.camera == "static":
            warnings.append(f"{said}, and is blurred by them, as the camera was declared static")
        else:
            warnings.append(f"{said}, and they are left out (--camera static keeps them)")
            track = track.without(moved)
    track = replace(track, provenance=track.provenance + how, figures={**track.figures, **figures})
    return ChosenCameras(track, warnings=warnings)


def _doubts(motion: BackgroundMotion, declared: bool) -> list[str]:
    """A sentence for the report if a camera that is taken to stand still may not do so."""
    if not motion.known and declared:
        return []
    if not motion.known:
        return [
            f"only {motion.features} features lie outside the masks, too few to tell "
            "whether the camera moves: it is taken to stand still (--camera moving if not)"
        ]
    if motion.static:
        return []
    if motion.turned is not None:
        return [f"{_turns(motion)}, but was declared static: the scene is blurred by as much"]
    seen = np.isfinite(motion.displacement).sum()
    return [
        f"the camera was declared static, but it moves: the background by up to "
        f"{motion.largest:.1f} px {PIXELS}, in {seen} of {len(motion.displacement)} "
        "compared frames that show it again; without --camera static hoigs finds its way"
    ]


def _from_motion(
    video: Frames,
    masks: GivenMasks,
    options: PrepareOptions,
    lens: tuple[Lens, str] | None,
    folder: Path,
    progress: Callable[[float], None],
) -> ChosenCameras:
    focal = options.focal and options.focal * video.width / video.native_width
    try:
        found = structure_from_motion(
            video, masks, folder / "sfm", focal=focal, lens=None if lens is None else lens[0],
            progress=progress,
        )  # fmt: skip
    except SourceError as error:
        motion = background_motion(video, masks)
        if not np.isfinite(motion.parallax):
            raise
        raise SourceError(
            f"{_turns(motion)}, and turns alone leave {motion.parallax:.1f} px of it: --camera "
            f"turning has that error, and is nearer than --camera static. {error}"
        ) from error
    track = colmap_cameras(video, found.model, partial=True)
    figures, warnings = dict(track.figures), list[str]()
    if found.focals is not None:
        low, high = (round(f * video.native_width / video.width, 1) for f in found.focals)
        figures |= {"focal_low_px": low, "focal_high_px": high}
        if not found.confirmed:
            warnings.append(
                "structure from motion led to this focal length from one start alone: "
                f"{low:.0f} to {high:.0f} px are usual or found, and cameras and depths follow it: "
                "give --focal or --calibration if you know the lens"
            )
    track = replace(
        track,
        provenance=f"structure from motion without the masked pixels: {track.provenance}",
        figures=figures,
    )
    lost = len(video) - len(track.positions)
    if lost:
        warnings.append(
            f"structure from motion gave no camera to {lost} of {len(video)} frames: they are "
            "left out of the clip"
        )
    return ChosenCameras(track, warnings=warnings)
