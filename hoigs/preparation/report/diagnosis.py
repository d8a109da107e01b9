"""How far each part of a prepared clip may be trusted, and what to do where it is not good."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from hoigs.core.reporting import Diagnostic, Severity, ranges
from hoigs.preparation.report.measures import BodyWithin, Measures
from hoigs.preparation.report.object_seen import OUT, SEEN

AGREES = 0.5  # correlation of textures from which the object's rotation is trusted
COVERED = 0.5  # of the frames: with landmarks in fewer, the body is not good, however near to them
BLURRED = 0.5  # of the median sharpness: a frame below it is blurred


@dataclass(frozen=True)
class MeasureDiagnostic(Diagnostic):
    """One measure, judged: `kind` is its name, `what` its meaning. `do` is "" where it is good."""

    value: str = ""


def diagnose(measures: Measures) -> list[MeasureDiagnostic]:
    """Every measure that can be judged, in the order of the stages."""
    return [
        *_cameras(measures),
        *_up(measures),
        *_frames(measures),
        *_tracks(measures),
        *_views(measures),
    ]


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
            "--camera moving declares that the camera does move.",
        )
        yield from _focal_length(report, "all depths scale with it")
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
    yield from _focal_length(report, "cameras and depths follow it")
    yield _judged(
        "parallax",
        f"{report.parallax_degrees:.1f}°",
        "largest angle between two views of the scene's middle",
        _judge(-report.parallax_degrees, -10, -5),
        "the scene's depth is weakly known: walk around the person next time, or add an "
        "estimator of depth",
    )


def _focal_length(report: Measures, meaning: str) -> Iterator[MeasureDiagnostic]:
    if report.focal_px is None or report.focal_range is None:
        return
    low, high = report.focal_range
    yield _judged(
        "focal length",
        f"{report.focal_px:.0f} px",
        f"{low * report.focal_px:.0f} to {high * report.focal_px:.0f} px are possible, and "
        f"{meaning}",
        _judge(max(high - 1, 1 - low), 0.05, 0.25),
        "give --focal, --intrinsics or --calibration if you know the lens",
    )


UP = {
    "floor": "feet that stood in several places", "lines": "vertical lines of the room",
    "body": "people who stand", "given": "the data",
}  # fmt: skip


def _up(report: Measures) -> Iterator[MeasureDiagnostic]:
    if not report.up_known:
        return
    known = report.up_within is not None
    yield _judged(
        "up",
        f"± {report.up_within:.1f}°" if known else "a guess",
        f"by {UP[report.up_known]}"
        if report.up_known in UP
        else "the cameras are taken to be level: it is wrong by as much as they look down or up",
        _judge(report.up_within or 0.0, 3.0, 10.0) if known else "bad",
        "film where walls, doors or shelves are in view, and let somebody stand for a moment; give "
        "--focal, by which a tilt scales",
    )


def _frames(report: Measures) -> Iterator[MeasureDiagnostic]:
    for name, coverage in report.coverage.items():
        if name in report.objects_seen and report.objects_seen[name].states:
            continue  # `_objects_seen` says what its empty frames are
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
    frames = max(1, report.frames)
    found_in = [of["found"] / frames for of in report.landmarks.values()]
    for name, found in report.further_people.items():
        people[f"body of {name}"] = found["body_residual_px"], found["body_residual_m"]
    shares = dict(zip(people, found_in, strict=False))  # both begin with the first person
    for name, (pixels, away) in people.items():
        if pixels is None:
            continue
        metres = "" if away is None else f", {100 * away:.1f} cm"
        share = shares.get(name, 1.0)
        judged = _judge(pixels / max(report.width, report.height), 0.01, 0.02)
        yield _judged(
            f"{name} on its landmarks",
            f"{pixels:.1f} px{metres}",
            f"median distance of visible landmarks, in the {100 * share:.0f} % of the frames that "
            "have some",
            judged if share >= COVERED else "bad",
            "look at overlay.mp4: if the landmarks jump, use another estimator "
            "(estimators.landmarks); if all of the body is off, the focal length or the cameras "
            "are; where most frames have no landmarks, the body is a guess there: click on the "
            "person (--person X,Y@FRAME)",
        )


def _guessed(name: str, within: BodyWithin, frames: int) -> Iterator[MeasureDiagnostic]:
    """Limbs that are guesses in some frames; those that are hardly ever seen have a warning."""
    found = {
        limb: rows
        for limb, rows in within.guessed.items()
        if rows and f"{limb.split()[-1]}s" not in within.unseen
    }
    if found:
        most = max(map(len, found.values()))
        yield _judged(
            f"limbs of {name}",
            f"{most} of {frames} frames guessed",
            "; ".join(f"{limb} in frames {ranges(rows)}" for limb, rows in found.items())
            + ": its landmarks are hidden or out of the picture, or it is drawn where no mask is; "
            "it may be off by a hand's length and more",
            _judge(most / frames, 0.05, 0.5),
            "look at these frames in overlay.mp4; leave them out if the limb matters (--start, "
            "--end)",
        )


def _in_space(report: Measures) -> Iterator[MeasureDiagnostic]:
    """How far each body may be off, which its landmarks in the image do not show."""
    low, high = report.focal_range or (1.0, 1.0)
    for name, within in report.bodies_within.items():
        if all(v is None for v in within.joints):
            yield _judged(
                f"joints of {name}",
                "not known",
                "the fit's equations do not say how far each of its numbers may be off",
                "bad",
                "judge the body by overlay.mp4 and from other sides",
            )
            continue
        off, worst = _middle(within.joints, 0.5), _middle(within.joints, 0.95)
        yield _judged(
            f"joints of {name}",
            f"± {1000 * off:.0f} mm",
            "those that are seen, about the shoulders, on average in four of five frames; "
            f"± {1000 * worst:.0f} mm in the worst twentieth of them",
            _judge(off, 0.05, 0.15),
            "limbs that point to the camera or away from it are known least: judge the body from "
            "other sides than the camera's, and film with a camera that moves around the person",
        )
        yield from _guessed(name, within, report.frames)
        share = math.hypot(_middle(within.distance, 0.5) / within.away, max(high - 1, 1 - low))
        legs = "; with the legs out of view nothing else shows it" * ("legs" in within.unseen)
        yield _judged(
            f"distance of {name}",
            f"± {100 * share:.0f} %",
            f"{100 * share * within.away:.0f} cm; it follows from the body's size, which is "
            f"{within.size_from}{legs}",
            _judge(share, 0.05, 0.15),
            "give --person-height, if you know it",
        )


def _middle(values: Sequence[float | None], quantile: float) -> float:
    known = sorted(v for v in values if v is not None)
    return known[int(quantile * (len(known) - 1))]


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
    yield from _in_space(report)
    if report.object_scale_spread is not None:
        yield _judged(
            "object's apparent size",
            f"± {100 * report.object_scale_spread:.1f} %",
            "over its expected size; its depth is as uncertain",
            _judge(report.object_scale_spread, 0.05, 0.15),
            "the object's masks grow and shrink, or it turns: mend the masks, or give its shape as "
            "a mesh (initializer:mesh)",
        )
    yield from _objects_seen(report)
    yield from _object_judged(report)
    if report.depth_residual is not None:
        yield _judged(
            "depth",
            f"{100 * report.depth_residual:.1f} %",
            f"off {report.depth_against}, after its scale was fitted",
            _judge(report.depth_residual, 0.05, 0.1),
            "the depth network misjudges this scene: try another, or leave its loss out "
            "(--set train.loss.depth=0)",
        )


def _objects_seen(report: Measures) -> Iterator[MeasureDiagnostic]:
    """Each object's verified frames, and the click that would help most."""
    for name, seen in report.objects_seen.items():
        if seen.share is None:
            continue
        severity = _judge(seen.missed, 0.1, 0.4)
        if severity == "good" and OUT in seen.states:
            severity = "fair"  # that it is out follows from how it moved, and is not seen
        shown = set(seen.states.get(SEEN, []))
        advice = seen.advice or "nothing can be done where it is hidden or out of the picture"
        one = _judged(
            f"{name} seen",
            f"{100 * seen.share:.0f} % of the frames",
            f"verified: its looks, size and way agree there; {seen.unseen}",
            severity,
            f"{advice} (--object {name}=X,Y@FRAME)" if seen.advice else advice,
        )
        yield replace(one, frames=tuple(i for i in range(report.frames) if i not in shown))


def _object_judged(report: Measures) -> Iterator[MeasureDiagnostic]:
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
    if report.object_way == "rod":
        yield _judged(
            "object's rotation", "its axis alone", report.object_reason, "fair",
            "what is round about its axis, as a club's shaft is, needs no more; if it is no rod, "
            "--set object_track=texture",
        )  # fmt: skip
    if report.object_way != "texture and hands":
        return
    known = [v for v in report.object_agreement if v is not None]
    shown = sum(v is not None for v in report.object_iou)
    trusted = sum(v >= AGREES for v in known) / max(1, shown)
    middle = sorted(known)[len(known) // 2] if known else 0.0
    yield _judged(
        "object's rotation",
        f"{100 * trusted:.0f} % of the frames that show it",
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
