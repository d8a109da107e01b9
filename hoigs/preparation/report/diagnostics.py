"""How good the measures of a preparation are, and what to do where they are not good.

The limits between good, fair and bad are our own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from hoigs.core.diagnostics import Diagnostic, Severity, ranges
from hoigs.preparation.report.measures import Measures

AGREES = 0.5  # correlation of textures from which the object's rotation is trusted
BLURRED = 0.5  # of the median sharpness: a frame below it is blurred


@dataclass(frozen=True)
class MeasureDiagnostic(Diagnostic):
    """One measure, judged: `kind` is its name, `what` its meaning. `do` is "" where it is good."""

    value: str = ""


def diagnose(measures: Measures) -> list[MeasureDiagnostic]:
    """Every measure that can be judged, in the order of the stages."""
    return [*_cameras(measures), *_frames(measures), *_tracks(measures), *_views(measures)]


def _judge(value: float, good: float, fair: float) -> Severity:
    """By the largest values that are good and fair."""
    return "good" if value <= good else "fair" if value <= fair else "bad"


def _judged(
    kind: str, value: str, meaning: str, severity: Severity, advice: str
) -> MeasureDiagnostic:
    do = "" if severity == "good" else advice
    return MeasureDiagnostic(kind, meaning, do, severity=severity, value=value)


def _cameras(report: Measures) -> Iterator[MeasureDiagnostic]:
    if report.camera != "moving":
        moved = report.displacement_px
        yield _judged(
            "camera",
            report.camera,
            "taken to turn on its spot"
            if report.camera == "turning"
            else "taken to stand still"
            + (f": the background moves by {moved:.2f} px at 640" if moved is not None else ""),
            "fair",
            "the background has one view and no measured depth: it looks right from near the "
            "camera only. An estimator of depth (--set estimators.depth.use=…) gives it one; "
            "--camera moving declares that the camera does move. Give --focal: all depths "
            "scale with it.",
        )
        return
    if report.registered is not None:
        yield _judged(
            "frames with a camera",
            f"{100 * report.registered:.0f} %",
            "the others are left out of the clip",
            _judge(1 - report.registered, 0.02, 0.2),
            "look at the masks (everything that moves must be masked, the background not), take "
            "sharper or more frames, or run COLMAP yourself and put its model at sparse/",
        )
    if report.reprojection_px is not None:
        yield _judged(
            "reprojection error",
            f"{report.reprojection_px:.2f} px",
            "of the scene's points in the images",
            _judge(report.reprojection_px, 1.0, 2.0),
            "cameras are off by about as much: let training refine them (train.rates.camera), or "
            "look for movement outside the masks",
        )
    yield _judged(
        "parallax",
        f"{report.parallax_degrees:.1f}°",
        "largest angle between two views of the scene's middle",
        _judge(-report.parallax_degrees, -10, -5),
        "the scene's depth is weakly known: walk around the person next time, or add an "
        "estimator of depth",
    )


def _frames(report: Measures) -> Iterator[MeasureDiagnostic]:
    for name, coverage in report.coverage.items():
        empty = sum(value == 0 for value in coverage) / max(1, len(coverage))
        mean = sum(coverage) / max(1, len(coverage))
        yield _judged(
            f"mask of {name}",
            f"{100 * mean:.1f} %",
            f"of the image; empty in {100 * empty:.0f} % of the frames",
            _judge(empty, 0.05, 0.25),
            "if it is in view there, the segmenter lost it: prompt it again in those frames",
        )
    if report.sharpness:
        middle = sorted(report.sharpness)[len(report.sharpness) // 2]
        blurred = sum(v < BLURRED * middle for v in report.sharpness) / len(report.sharpness)
        yield _judged(
            "blurred frames",
            f"{100 * blurred:.0f} %",
            "less than half as sharp as the middle one",
            _judge(blurred, 0.05, 0.2),
            "take the sharpest of each few frames (--every 2, --fps 15), film in more light or "
            "move the camera slower",
        )


def _bodies(report: Measures) -> Iterator[MeasureDiagnostic]:
    people = {"body": (report.body_residual_px, report.body_residual_m)}
    for name, found in report.further_people.items():
        people[f"body of {name}"] = found["body_residual_px"], found["body_residual_m"]
    for name, (pixels, away) in people.items():
        if pixels is None:
            continue
        metres = "" if away is None else f", {100 * away:.1f} cm"
        yield _judged(
            f"{name} on its landmarks",
            f"{pixels:.1f} px{metres}",
            "median distance of visible landmarks",
            _judge(pixels / max(report.width, report.height), 0.01, 0.02),
            "look at overlay.mp4: if the landmarks jump, use another estimator "
            "(estimators.landmarks); if all of the body is off, the focal length or the cameras "
            "are",
        )


def _landmarks(report: Measures) -> Iterator[MeasureDiagnostic]:
    """Frames with landmarks of each person; every other one with its reason."""
    for name, of in report.landmarks.items():
        lost = sorted(i for frames in of["lost"].values() for i in frames)
        reasons = [
            f"{text} in {len(frames)} ({ranges(frames, most=len(frames))})"
            for key in ("lost", "repaired")
            for text, frames in of[key].items()
        ]
        one = _judged(
            f"landmarks of {name}",
            f"{of['found']} of {report.frames} frames",
            "; ".join(reasons) or "all found at once",
            _judge(len(lost) / max(1, report.frames), 0.05, 0.2),
            "the body follows its neighbours in the other frames, and the masks: click on the "
            "person in one of them (--person X,Y@FRAME), leave these parts out (--start, --end), "
            "or use another estimator (estimators.landmarks)",
        )
        yield replace(one, frames=tuple(lost))


def _tracks(report: Measures) -> Iterator[MeasureDiagnostic]:
    yield from _landmarks(report)
    yield from _bodies(report)
    if report.object_scale_spread is not None:
        yield _judged(
            "object's apparent size",
            f"± {100 * report.object_scale_spread:.1f} %",
            "over its expected size; its depth is as uncertain",
            _judge(report.object_scale_spread, 0.05, 0.15),
            "the object's masks grow and shrink, or it turns: mend the masks, or give its shape as "
            "a mesh (initializer:mesh)",
        )
    yield from _object(report)
    if report.depth_residual is not None:
        yield _judged(
            "depth",
            f"{100 * report.depth_residual:.1f} %",
            f"off {report.depth_against}, after its scale was fitted",
            _judge(report.depth_residual, 0.05, 0.1),
            "the depth network misjudges this scene: try another, or leave its loss out "
            "(--set train.loss.depth=0)",
        )


def _object(report: Measures) -> Iterator[MeasureDiagnostic]:
    """The object's rotation and shape, and the hands on it."""
    if report.object_way == "outline":
        yield _judged(
            "object's rotation",
            "not tracked",
            f"only its roll in the image is known: {report.object_reason}",
            "bad",
            "training has to find rotation and shape: film the object larger, sharper and whole, "
            "mend its masks, or choose a spec whose object deforms",
        )
    yield from _object_outline(report)
    if report.object_way == "ball":
        yield _judged(
            "object's rotation", "unknown", report.object_reason, "fair",
            "the object does not turn in the clip; if it is no ball, --set object_track=texture",
        )  # fmt: skip
    if report.object_way != "texture and hands":
        return
    known = [v for v in report.object_agreement if v is not None]
    trusted = sum(v >= AGREES for v in known) / max(1, len(report.object_agreement))
    middle = sorted(known)[len(known) // 2] if known else 0.0
    yield _judged(
        "object's rotation",
        f"{100 * trusted:.0f} % of the frames",
        f"its texture agrees there with that of other frames (correlation {middle:.2f}, median); "
        f"worst in {_worst(report.object_agreement)}",
        _judge(1 - trusted, 0.1, 0.3),
        "the others follow their neighbours and the hands. Where the object is hidden nothing can "
        "be done; where it is blurred or small, take sharper frames",
    )
    off = [1000 * v for v in report.object_outline_m if v is not None]
    worst = sorted(off)[int(0.95 * (len(off) - 1))]
    yield _judged(
        "object's shape",
        f"{sum(off) / len(off):.0f} mm",
        f"between its outline and the mask's ({worst:.0f} mm in the worst twentieth of the frames)",
        _judge(report.object_scale_spread or 0.0, 0.05, 0.15),
        "it is not rigid, or its masks are off: a spec whose object deforms may fit better",
    )
    palms = [1000 * v for v in report.hand_distance_m if v is not None]
    if palms:
        middle = sorted(palms)[len(palms) // 2]
        yield _judged(
            "hands on the object",
            f"{middle:.0f} mm",
            f"from the nearest palm to its surface, median of {len(palms)} frames in which hands "
            f"move it; deepest inside {max(0.0, -min(palms)):.0f} mm",
            _judge(abs(middle), 60, 120),
            "body and object are at different distances: look at both in overlay.mp4",
        )


def _object_outline(report: Measures) -> Iterator[MeasureDiagnostic]:
    known = sorted(v for v in report.object_iou if v is not None)
    if known:
        mean = sum(known) / len(known)
        yield _judged(
            "object on its mask",
            f"IoU {mean:.2f}",
            f"mean of its outline and the mask's; {known[int(0.05 * len(known))]:.2f} in the worst "
            f"twentieth; worst in {_worst(report.object_iou)}",
            _judge(1 - mean, 0.15, 0.3),
            "look at these frames in overlay.mp4: poses, shape or masks are off there",
        )


def _worst(values: list[float | None], count: int = 3) -> str:
    """The frames with the smallest values."""
    known = [(v, i) for i, v in enumerate(values) if v is not None]
    worst = sorted(i for _, i in sorted(known)[:count])
    return f"frames {', '.join(map(str, worst))}"


def _views(report: Measures) -> Iterator[MeasureDiagnostic]:
    if report.omega is None:
        return
    ratio = "" if report.big_omega is None else f", {report.big_omega:.2g} times as fast as it"
    yield _judged(
        "effective multi-view factor",
        f"{report.omega:.1f}°/s",
        f"the camera goes round the person{ratio} (DyCheck's omega and Omega)",
        _judge(-report.omega, -40, -10),
        "each moment is seen from one side: what is hidden is guessed by the body model and the "
        "object's rigidity. Judge by held-out cameras, not by this camera's own frames.",
    )
