"""Which cameras a video gets: COLMAP's, one that stands still, or those of its own SfM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from hoigs.core.values.lens import Lens
from hoigs.preparation.cameras.calibration import fitting, given_intrinsics, read_calibration
from hoigs.preparation.cameras.camera_track import (
    CameraTrack,
    colmap_cameras,
    pinhole,
    static_cameras,
)
from hoigs.preparation.cameras.given_cameras import given_cameras
from hoigs.preparation.cameras.motion import background_motion
from hoigs.preparation.cameras.sfm import structure_from_motion
from hoigs.preparation.cameras.static_focal import static_focal
from hoigs.preparation.given import GivenMasks, RawLandmarks
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError


@dataclass(frozen=True)
class ChosenCameras:
    """Cameras, whether their COLMAP model lies in a temporary folder, and warnings."""

    track: CameraTrack
    own_model: bool = False
    warnings: list[str] = field(default_factory=list)


def choose_cameras(
    video: Frames,
    landmarks: RawLandmarks,
    masks: GivenMasks,
    model: Path | None,
    options: PrepareOptions,
    folder: Path,
    progress: Callable[[float], None],
    given: Path | None = None,
) -> ChosenCameras:
    """Cameras as `options.camera` requests them.

    Args:
        landmarks, masks: of the raw frames. model: a COLMAP model that is there already, or None.
        given: cameras.npz, or None.
        folder: to work in; it may be removed when the result has been kept.

    Raises:
        SourceError: the model does not fit, or structure from motion fails.
    """
    lens = known_lens(options, video)
    beside = None if options.camera in {"static", "sfm"} else given or model
    if lens is not None and beside is not None:
        raise SourceError(
            f"{beside.name} beside the video has a lens already: leave {lens[1]} out, or use "
            "--camera sfm or static to make the cameras anew"
        )
    if options.camera not in {"static", "sfm"} and given is not None:
        return ChosenCameras(given_cameras(video, given))
    if options.camera not in {"static", "sfm"} and model is not None:
        return ChosenCameras(colmap_cameras(video, model))
    if options.camera == "static":
        return _static(video, landmarks, options, lens, "", {})
    if options.camera == "auto":
        motion = background_motion(video, masks)
        if motion.static:
            figures = {"displacement_px": round(motion.largest, 3)} if motion.known else {}
            how = (
                f"; features outside the masks move by up to {motion.largest:.2f} px at a width "
                "of 640"
                if motion.known
                else ""
            )
            chosen = _static(video, landmarks, options, lens, how, figures)
            if not motion.known:
                chosen.warnings.append(
                    f"only {motion.features} features lie outside the masks, too few to tell "
                    "whether the camera moves: it is taken to stand still (--camera moving if not)"
                )
            return chosen
    return _from_motion(video, masks, options, lens, folder, progress)


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
    landmarks: RawLandmarks,
    options: PrepareOptions,
    lens: tuple[Lens, str] | None,
    how: str,
    figures: dict[str, float],
) -> ChosenCameras:
    if lens is not None:
        track = static_cameras(video, *lens)
        track = replace(
            track, provenance=track.provenance + how, figures={**track.figures, **figures}
        )
        return ChosenCameras(track)
    found = static_focal(video, landmarks, options.focal)
    track = static_cameras(video, pinhole(video, found.pixels), found.how)
    figures = {**figures, **found.figures}
    track = replace(track, provenance=track.provenance + how, figures=figures)
    return ChosenCameras(track, warnings=list(found.warnings))


def _from_motion(
    video: Frames,
    masks: GivenMasks,
    options: PrepareOptions,
    lens: tuple[Lens, str] | None,
    folder: Path,
    progress: Callable[[float], None],
) -> ChosenCameras:
    focal = options.focal and options.focal * video.width / video.native_width
    model = structure_from_motion(
        video, masks, folder / "sfm", focal=focal, lens=None if lens is None else lens[0],
        progress=progress,
    )  # fmt: skip
    track = colmap_cameras(video, model, partial=True)
    track = replace(
        track, provenance=f"structure from motion without the masked pixels: {track.provenance}"
    )
    warnings = []
    lost = len(video) - len(track.positions)
    if lost:
        warnings.append(
            f"structure from motion gave no camera to {lost} of {len(video)} frames: they are "
            "left out of the clip"
        )
    return ChosenCameras(track, own_model=True, warnings=warnings)
