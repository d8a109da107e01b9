"""The report of a preparation: what was made, how well, and how far each part may be trusted."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from hoigs.core.reporting import Diagnostic, Severity, ranges
from hoigs.preparation.report.object_seen import SEEN, ObjectSeen, named

# What is measured of a preparation.


@dataclass(frozen=True)
class BodyWithin:
    """Within which a body is in four of five frames; of each frame, metres.

    Attributes:
        joints: mean distance of the joints that are seen, about the middle of the shoulders; None
            where it is not known.
        distance: of that middle from the camera. away: how far off the person is, median.
        size_from: how the body's size is known. unseen: parts that are hardly ever seen.
        guessed: by limb, the frames in which the picture hides it or shows it elsewhere; `joints`
            does not hold there.
    """

    joints: list[float | None]
    distance: list[float | None]
    away: float
    size_from: str
    unseen: list[str] = field(default_factory=list)
    guessed: dict[str, list[int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Measures:
    """Numbers to judge a prepared clip by.

    Attributes:
        name, frames, width, height, fps: of the clip. video: the source's file name.
        camera: "static", "turning" or "moving". parallax_degrees: largest angle between two views
            of the scene's middle; under about 5 the geometry is weakly known.
        coverage: by entity, part of the image that the mask covers in each frame, 0..1.
        body_residual_px: median distance of fitted to given landmarks, in frame pixels, of the
            first person; None without people.
        body: whatever else the body fit reports. bodies_within: by person, how far it may be off.
        landmarks: by person, `found`: frames with landmarks; `lost` and `repaired`: by the reason,
            which frames have none, and which only after more than a first look.
        scene_scale: metres a COLMAP unit; 1 for a static camera.
        object_scale_spread: standard deviation over frames of the object's apparent over its
            expected size: 0.05 means that its depth is uncertain by about 5 %; None
            without an object.
        object_observed: part of the frames in which the object was seen.
        scene_points: number of points that start the background.
        provenance: what each part was made from, and how weak it is.
        warnings: what to know before training.
        unknown: what the video does not show and is supposed, and why.
        seconds: time by stage.
        registered: part of the chosen frames that have a camera; None for a static camera.
        reprojection_px: of COLMAP's points, mean; None for a static camera.
        focal_px: of the stored frames. focal_range: shortest and longest that it may be, as shares
            of it; None: it is given, or of structure from motion.
        up_known: what tells which way is up (`hoigs.core.values.world.World`). up_within: degrees
            within which it is; None: not known.
        displacement_px: of a static camera's background, at a width of 640; None if not measured.
        sharpness: of each frame (`sharpness.sharpness`).
        body_residuals_px: of each frame; None without landmarks.
        body_residual_m: `body_residual_px` at the person's distance.
        depth_residual: typical relative error of the depth estimator once it is in metres, against
            `depth_against`; depth_residuals: of each frame. None without such an estimator.
        object_way: how the object's poses were found: "texture and hands", "outline" or "ball";
            object_reason: why not better.
        object_agreement: of each frame, correlation of the object's texture with that of the other
            frames; None where it shows too little. object_outline_m: metres between the mask's
            outline and the shape's. object_iou: of each frame, intersection over union of both.
        object_held, object_rests: parts of the frames in which hands move it, and it rests.
        hand_distance_m: of each frame, from the nearest palm to its surface while held; negative
            inside.
        object_name: of the object that the measures above are of.
        objects_seen: by name of every object, in which frames it is seen and how well it is placed.
        further_objects: by name, the same measures of the other objects. further_people: by name,
            body_residual_px and body_residual_m of the other people.
        omega, big_omega: effective multi-view factors (`multiview`).
    """

    name: str
    video: str
    frames: int
    width: int
    height: int
    fps: float
    camera: str
    parallax_degrees: float
    coverage: dict[str, list[float]]
    body_residual_px: float | None
    scene_scale: float
    object_scale_spread: float | None
    object_observed: float | None
    scene_points: int
    body: dict[str, Any] = field(default_factory=dict)
    bodies_within: dict[str, BodyWithin] = field(default_factory=dict)
    landmarks: dict[str, dict[str, Any]] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    unknown: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    registered: float | None = None
    reprojection_px: float | None = None
    displacement_px: float | None = None
    focal_px: float | None = None
    focal_range: tuple[float, float] | None = None
    up_known: str = ""
    up_within: float | None = None
    sharpness: list[float] = field(default_factory=list)
    body_residuals_px: list[float | None] = field(default_factory=list)
    body_residual_m: float | None = None
    depth_residual: float | None = None
    depth_residuals: list[float | None] = field(default_factory=list)
    depth_against: str = ""
    object_way: str = ""
    object_reason: str = ""
    object_agreement: list[float | None] = field(default_factory=list)
    object_iou: list[float | None] = field(default_factory=list)
    object_outline_m: list[float | None] = field(default_factory=list)
    object_held: float = 0.0
    object_rests: float = 0.0
    hand_distance_m: list[float | None] = field(default_factory=list)
    object_name: str = "object"
    objects_seen: dict[str, ObjectSeen] = field(default_factory=dict)
    further_objects: dict[str, dict[str, Any]] = field(default_factory=dict)
    further_people: dict[str, dict[str, float]] = field(default_factory=dict)
    omega: float | None = None
    big_omega: float | None = None


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
        if report.focal_px is not None and report.focal_range is not None:
            low, high = report.focal_range
            yield _judged(
                "focal length",
                f"{report.focal_px:.0f} px",
                f"{low * report.focal_px:.0f} to {high * report.focal_px:.0f} px are possible, and "
                "all depths scale with it",
                _judge(max(high - 1, 1 - low), 0.05, 0.25),
                "give --focal, --intrinsics or --calibration if you know the lens",
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
        shown = set(seen.states.get(SEEN, []))
        advice = seen.advice or "nothing can be done where it is hidden or out of the picture"
        one = _judged(
            f"{name} seen",
            f"{100 * seen.share:.0f} % of the frames",
            f"verified: its looks, size and way agree there; {seen.unseen}",
            _judge(1 - seen.share, 0.1, 0.4),
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


# report.html: one file, which has overlay.mp4 and object.jpg inside and loads nothing.

WIDTH, HEIGHT = 300, 90  # of a plot, in its own units
Series = Mapping[str, Sequence[float | None]]
CAMERAS = {
    "static": "a camera that stands still", "turning": "a camera that turns on its spot",
    "moving": "a moving camera",
}  # fmt: skip


def report_page(
    report: Measures,
    diagnostics: Sequence[MeasureDiagnostic],
    rows: Sequence[Sequence[str]],
    *,
    folder: Path,
) -> str:
    """The page; `rows` are what, value and note of each measure, `folder` may have overlay.mp4 and
    object.jpg."""
    page = (resources.files(__package__) / "page.html").read_text(encoding="utf-8")
    camera = CAMERAS[report.camera]
    return Template(page).substitute(
        title=escape(report.name),
        lead=escape(
            f"{report.frames} frames of {report.video}, {report.width}×{report.height} at "
            f"{report.fps:g} a second, from {camera}."
        ),
        video=_within(_VIDEO, folder / "overlay.mp4") + _within(_OBJECT, folder / "object.jpg"),
        diagnostics="\n".join(map(_diagnostic, diagnostics)),
        plots=_plots(report),
        rows=_rows(rows),
        made=_rows(list(report.provenance.items())),
        warnings=_listed("Not known", [f"{what}: {why}" for what, why in report.unknown.items()])
        + _listed("Beware", report.warnings),
    )


_VIDEO = (
    "<video src='data:video/mp4;base64,{}' controls loop muted playsinline></video><p class='note'>"
    "The fitted body in blue, the masks' outlines in green and yellow, points of the object in "
    "magenta. If the body does not lie on the person here, nothing after it will be right.</p>"
)
_OBJECT = (
    "<img src='data:image/jpeg;base64,{}' alt='the object in one frame' width='100%'><p "
    "class='note'>What was taken for the object. If it is something else, run the same command "
    "with <code>--object X,Y@FRAME</code>, a point on it in pixels of the video: only what depends "
    "on the object is made again.</p>"
)


def _within(text: str, path: Path) -> str:
    """The text with the file's bytes; nothing where there is none."""
    return text.format(base64.b64encode(path.read_bytes()).decode()) if path.is_file() else ""


def _diagnostic(one: MeasureDiagnostic) -> str:
    advice = f"<p>{escape(one.do)}</p>" if one.do else ""
    return (
        f"<div class='diagnostic {one.severity}'><span><b>{escape(one.kind)}</b> "
        f"<small>{escape(one.what)}</small></span><em>{escape(one.value)} · "
        f"{one.severity}</em>{advice}</div>"
    )


def _plots(report: Measures) -> str:
    percent = {name: [100 * value for value in values] for name, values in report.coverage.items()}
    plots = [plot("Masks, % of the image", percent)]
    if report.sharpness:
        plots.append(plot("Sharpness", {"": report.sharpness}))
    if any(v is not None for v in report.body_residuals_px):
        plots.append(plot("Body off its landmarks, px", {"": report.body_residuals_px}))
    for name, within in report.bodies_within.items():
        off = [None if v is None else 1000 * v for v in within.joints]
        plots.append(plot(f"Joints of {name} within, mm", {"": off}))
    if any(v is not None for v in report.object_agreement):
        plots.append(plot("Object's texture against other frames", {"": report.object_agreement}))
    if any(v is not None for v in report.depth_residuals):
        off = [None if v is None else 100 * v for v in report.depth_residuals]
        plots.append(plot(f"Depth off {report.depth_against}, %", {"": off}))
    return "".join(plots)


def plot(title: str, series: Series) -> str:
    """Lines over the frames, from 0 to the largest value; None leaves a gap."""
    top = max((v for values in series.values() for v in values if v is not None), default=0.0)
    lines = []
    for values, style in zip(series.values(), "abab", strict=False):
        step = WIDTH / max(1, len(values) - 1)
        for run in _runs(values):
            points = " ".join(
                f"{i * step:.1f},{HEIGHT * (1 - value / (top or 1)):.1f}" for i, value in run
            )
            lines.append(f"<polyline class='{style}' points='{points}'/>")
    colours = zip(series, ("blue", "yellow", "blue", "yellow"), strict=False)
    legend = [f"{name} {colour}" for name, colour in colours if name]
    label = f"{title}, 0 to {top:.3g}" + (f"; {', '.join(legend)}" if legend else "")
    return (
        f"<figure><svg viewBox='0 -2 {WIDTH} {HEIGHT + 4}' preserveAspectRatio='none' role='img' "
        f"aria-label='{escape(label, quote=True)}'>{''.join(lines)}</svg>"
        f"<figcaption>{escape(label)}</figcaption></figure>"
    )


def _runs(values: Sequence[float | None]) -> list[list[tuple[int, float]]]:
    """Stretches without a gap, with frame numbers."""
    runs: list[list[tuple[int, float]]] = [[]]
    for i, value in enumerate(values):
        if value is None:
            runs.append([])
        else:
            runs[-1].append((i, value))
    # a line of one point shows nothing: it is drawn twice
    return [run * 2 if len(run) == 1 else run for run in runs if run]


def _rows(rows: Sequence[Sequence[str]]) -> str:
    cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
    return "".join(f"<tr>{row}</tr>" for row in cells)


def _listed(title: str, texts: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<h2>{title}</h2><ul>{items}</ul>" if texts else ""


@dataclass(frozen=True)
class PrepareReport(Measures):
    """Measures of a prepared clip, as report.json, report.md and report.html beside it."""

    def diagnostics(self) -> list[MeasureDiagnostic]:
        """Every measure that can be judged, and what to do where it is not good."""
        return diagnose(self)

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2, allow_nan=False)

    def rows(self) -> list[tuple[str, str, str]]:
        """What, value and note of each measure."""
        rows = [
            ("video", self.video, ""),
            ("frames", f"{self.frames} of {self.width}x{self.height}", f"{self.fps:g} fps"),
            ("camera", self.camera, f"parallax {self.parallax_degrees:.1f} degrees"),
            self._body_row("body", self.body_residual_px),
            *(self._body_row(n, m["body_residual_px"]) for n, m in self.further_people.items()),
            *(self._landmark_row(n) for n in self.landmarks),
            ("scene scale", f"{self.scene_scale:.4g}", "metres a unit of the source"),
        ]
        if self.object_observed is None or self.object_scale_spread is None:
            rows.append((self.object_name, "none", ""))
        else:
            name, spread = self.object_name, f"{100 * self.object_scale_spread:.1f} %"
            rows.append((f"{name} seen", f"{100 * self.object_observed:.0f} %", "of the frames"))
            rows.append((f"{name}'s scale spread", spread, "so its depth's"))
            rows.append((f"{name}'s poses", self.object_way, self.object_reason))
        for name, measured in self.further_objects.items():
            seen = f"{100 * measured['object_observed']:.0f} %"
            rows.append((f"{name} seen", seen, "of the frames"))
            rows.append((f"{name}'s poses", measured["object_way"], measured["object_reason"]))
        for name, known in self.objects_seen.items():
            rows += [(f"{name}: {what}", value, note) for what, value, note in named(known)]
        rows.append(("scene points", f"{self.scene_points}", ""))
        if self.depth_residual is not None:
            rows.append(
                ("depth", f"{100 * self.depth_residual:.1f} %", f"off {self.depth_against}")
            )
        if self.omega is not None:
            rows.append(("multi-view", f"{self.omega:.1f} °/s", "the camera around the person"))
        rows += [(f"mask of {n}", *_coverage(c)) for n, c in self.coverage.items()]
        rows.append(("time", f"{sum(self.seconds.values()):.0f} s", _times(self.seconds)))
        return rows

    @staticmethod
    def _body_row(name: str, residual: float | None) -> tuple[str, str, str]:
        if residual is None:
            return name, "none", "nobody was looked for"
        return name, f"{residual:.1f} px", "median distance from the landmarks"

    def _landmark_row(self, name: str) -> tuple[str, str, str]:
        of = self.landmarks[name]
        lost, repaired = (sum(map(len, of[key].values())) for key in ("lost", "repaired"))
        note = f"{lost} lost, {repaired} not found at once"
        return f"landmarks of {name}", f"{of['found']} of {self.frames} frames", note

    def to_markdown(self) -> str:
        table = "\n".join(f"| {what} | {value} | {note} |" for what, value, note in self.rows())
        made = "\n".join(f"- **{name}**: {text}" for name, text in self.provenance.items())
        lines = [f"# {self.name}", "", "| | | |", "|---|---|---|", table]
        lines += ["", "## Made from", "", made]
        todo = [
            f"- **{d.kind}: {d.value}** ({d.severity}), {d}" for d in self.diagnostics() if d.do
        ]
        if todo:
            lines += ["", "## What to do", "", *todo]
        if self.unknown:
            lines += ["", "## Not known", ""]
            lines += [f"- **{what}**: {why}" for what, why in self.unknown.items()]
        if self.warnings:
            lines += ["", "## Beware", "", *(f"- {w}" for w in self.warnings)]
        return "\n".join(lines) + "\n"

    def save(self, folder: Path) -> None:
        """report.json, report.md and report.html."""
        (folder / "report.json").write_text(self.to_json(), encoding="utf-8")
        (folder / "report.md").write_text(self.to_markdown(), encoding="utf-8")
        page = report_page(self, self.diagnostics(), self.rows(), folder=folder)
        (folder / "report.html").write_text(page, encoding="utf-8")


_BARS = "▁▂▃▄▅▆▇█"


def _coverage(values: list[float]) -> tuple[str, str]:
    """Mean part of the image; a sparkline over time, the maximum and the empty frames."""
    if not values:
        return "no frames", ""
    top = max(values) or 1.0
    chosen = [values[i * len(values) // 32] for i in range(32)] if len(values) > 32 else values
    line = "".join(_BARS[min(7, int(8 * v / top))] if v else " " for v in chosen)
    empty = sum(v == 0 for v in values)
    note = f", empty in {empty} frames" if empty else ""
    mean = sum(values) / len(values)
    return f"{100 * mean:.1f} %", f"of the image, {line} up to {100 * top:.1f} %{note}"


def _times(seconds: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
