"""Which focal length a still camera gets: the given one, the file's, the person's, a usual one."""

from __future__ import annotations

from dataclasses import dataclass, field

from hoigs.preparation.cameras.camera_track import ASSUMED_FOCAL
from hoigs.preparation.cameras.focal.from_person import FocalCurve, focal_curve
from hoigs.preparation.cameras.focal.metadata import focal_of_metadata
from hoigs.preparation.estimates.given import RawLandmarks
from hoigs.preparation.video.frames import Frames


@dataclass(frozen=True)
class StaticFocal:
    """A focal length in pixels of the video's own size, and how far to trust it.

    Attributes:
        how: a phrase that tells where it comes from. figures: of the search, for the report.
        known: it is given, or the file's metadata have it.
    """

    pixels: float
    how: str
    figures: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    known: bool = False


def static_focal(video: Frames, landmarks: RawLandmarks | None, given: float | None) -> StaticFocal:
    """The first of: `given`, the file's metadata, a distinct estimate from the person (`focal`),
    0.8 of the longer side.
    """
    if given is not None:
        return StaticFocal(given, "given", known=True)
    found = focal_of_metadata(video.path, video.native_width, video.native_height)
    if found is not None:
        return StaticFocal(found[0], f"from {found[1]}", known=True)
    longer = max(video.native_width, video.native_height)
    curve = None
    if landmarks is not None:
        size = (video.width, video.height)
        curve = focal_curve(landmarks.image[..., [0, 1, 3]], landmarks.world[..., :3], size)
    figures = {} if curve is None else _figures(curve, longer)
    if curve is not None and curve.distinct:
        return _estimated(curve, longer, figures)
    how = "assumed: 0.8 x the longer side; all depths scale with it"
    text = (
        "the focal length is assumed, and every depth is proportional to it: give --focal if you "
        f"know it ({_undecided(curve, longer)})"
    )
    return StaticFocal(ASSUMED_FOCAL * longer, how, figures, (text,))


def _estimated(curve: FocalCurve, longer: int, figures: dict[str, float]) -> StaticFocal:
    best, (low, high) = curve.best * longer, curve.range
    span = f"{low * longer:.0f} to {high * longer:.0f} px are within 5 % of the least error"
    text = (
        f"the focal length, {best:.0f} px, is estimated from the person's landmarks ({span}), and "
        "every depth is proportional to it: give --focal if you know it"
    )
    return StaticFocal(best, f"estimated from the landmarks; {span}", figures, (text,))


def _undecided(curve: FocalCurve | None, longer: int) -> str:
    if curve is None:
        return "too few landmarks are known in space to estimate it"
    low, high = (round(x * longer) for x in curve.range)
    first, second = (half * longer for half in curve.halves)
    return (
        f"the person's landmarks do not determine it: {low} and {high} px explain them equally "
        f"well; the best is {first:.0f} px in the first half of the frames, {second:.0f} px in the "
        "second"
    )


def _figures(curve: FocalCurve, longer: int) -> dict[str, float]:
    low, high = curve.range
    return {
        "focal_best_px": round(curve.best * longer, 1),
        "focal_low_px": round(low * longer, 1),
        "focal_high_px": round(high * longer, 1),
        "focal_error_px": round(float(curve.errors.min()), 3),
    }
