"""What is measured of a preparation: numbers to judge a prepared clip by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hoigs.preparation.report.object_seen import ObjectSeen


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
        focal_px: of the video, as --focal has it. focal_range: shortest and longest that it may be,
            as shares of it; None: it is given, or of structure from motion.
        up_known: what tells which way is up (`hoigs.core.values.world.World`). up_within: degrees
            within which it is; None: not known.
        displacement_px: of a static camera's background, at 640 along the longer side; None if not
            measured.
        sharpness: of each frame (`sharpness.sharpness`).
        body_residuals_px: of each frame; None without landmarks.
        body_residual_m: `body_residual_px` at the person's distance.
        depth_residual: typical relative error of the depth estimator once it is in metres, against
            `depth_against`; depth_residuals: of each frame. None without such an estimator.
        object_way: how its poses were found: "texture and hands", "outline", "rod" or "ball";
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
