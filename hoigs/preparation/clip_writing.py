"""The last stage: frames, tracks and the report become a clip folder, which appears when whole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.clip_folder.write import ClipWriter
from hoigs.core.interfaces.body import PELVIS
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import POSES_ESTIMATED
from hoigs.preparation.cameras.camera_track import parallax
from hoigs.preparation.cameras.multiview import angular_factor, full_factor
from hoigs.preparation.entities.people import FittedBody
from hoigs.preparation.objects.make_object import MadeObject
from hoigs.preparation.pipeline import Pipeline
from hoigs.preparation.report.overlay import OverlayVideo, save_object_picture, several, shown_frame
from hoigs.preparation.report.report import PrepareReport
from hoigs.preparation.stages import Cleanup
from hoigs.preparation.video.source import SourceError

BODY_JOINTS = 22  # without the hands', which are not fitted


def write_clip_folder(made: Pipeline, cleanup: Cleanup) -> PrepareReport:
    """Writes and checks what the other stages made, and gives the folder its name."""
    options = made.options
    entities: dict[str, Literal["human", "object"]] = dict.fromkeys(made.people.people, "human")
    entities |= dict.fromkeys(made.objects_made, "object")
    if not entities:
        raise SourceError(
            "no object was found in a clip without people: point at it with --object X,Y"
        )
    with ClipWriter(
        made.out, fps=made.video.fps, entities=entities, image_format=options.image_format,
        quality=options.quality, depth_kind="none" if made.depth is None else "metric",
        depth_dtype=np.float16,
    ) as writer:  # fmt: skip
        cleanup.register(writer.root)
        with made.stages.stage("writing"):
            _write_frames(made, writer)
        for name, poses in made.body_tracks().items():
            writer.set_body(name, poses)
        for name, thing in made.objects_made.items():
            writer.set_object(name, thing.track)
        writer.set_points(made.scene.points, made.scene.colors)
        writer.set_world(made.world())
        if made.video.uneven:
            writer.set_times(made.video.times)
        if made.track.model is not None:
            writer.set_colmap(made.track.model)
        writer.provenance.update(
            made.provenance,
            video=made.source.video.name,
            frames=made.video.indices,
            **{POSES_ESTIMATED: True},
        )
        report = _report(made, writer.name)
        report.save(writer.root)
    cleanup.remove()
    return report


def _write_frames(made: Pipeline, writer: ClipWriter) -> None:
    options = made.options
    picture = _object_picture(made)
    count = len(made.people.people)
    overlay = OverlayVideo(
        writer.root / "overlay.mp4",
        made.video.fps,
        options.overlay_width,
        several(made.body.faces, count),
    )
    with overlay:
        people = [person.posed(made.body) for person in made.people.people.values()]
        nobody = [torch.zeros(0, 3)]
        rows = zip(made.images(), made.cameras, made.masks.blank, strict=True)
        stacks, tracks = made.people_masks(), {n: t.track for n, t in made.objects_made.items()}
        for i, (image, camera, blank) in enumerate(made.stages.track(rows, len(made.video))):
            vertices = torch.cat(nobody + [next(one)[0] for one in people])
            masks = {n: stack[i] for n, stack in stacks.items()}
            human = np.logical_or.reduce([np.zeros_like(blank), *masks.values()])
            masks |= {n: made.object_masks(n)[i] for n in tracks}
            points = [t.points @ t.rotations[i].mT + t.translations[i] for t in tracks.values()]
            writer.add_frame(image, camera, masks, made.metres(i), blank)
            objects = made.masks.objects(i)
            if i == picture:
                save_object_picture(writer.root, image, objects)
            overlay.add(
                image, camera, vertices, human, objects, torch.cat([torch.zeros(0, 3), *points])
            )


def _object_picture(made: Pipeline) -> int | None:
    """Position of the frame that shows which object was taken; None where nobody had to choose."""
    if made.object is None or made.found_object is None:
        return None
    prompt = made.options.prompts.get(made.options.object)
    prompted = [at.frame or 0 for at in prompt.places()] if prompt else []
    coverage = made.masks.object.coverage().tolist()
    return shown_frame(made.video.indices, made.found_object.boxes, prompted, coverage)


def _report(made: Pipeline, name: str) -> PrepareReport:
    middle = torch.median(made.scene.points, dim=0).values
    options, person, figures = made.options, made.people.first, made.track.figures
    coverage = made.people_masks()
    joints = [one.joints[:, :BODY_JOINTS] for one in made.people.people.values()]
    places = [thing.track.translations[:, None] for thing in made.objects_made.values()]
    moving = torch.cat([*joints, *places], 1)
    middle_of_motion = moving[:, PELVIS]  # of the first person, or the first object
    coverage |= {held: made.object_masks(held) for held in made.objects_made}
    depth = made.depth
    return PrepareReport(
        name=name,
        video=made.source.video.name,
        frames=len(made.video),
        width=made.video.width,
        height=made.video.height,
        fps=made.video.fps,
        camera=made.track.kind,
        parallax_degrees=parallax(made.cameras, middle),
        coverage={n: m.coverage().round(5).tolist() for n, m in coverage.items()},
        body_residual_px=None if person is None else person.residual_px,
        scene_scale=made.people.world.scene_scale,
        object_scale_spread=None if made.object_made is None else made.object_made.spread,
        object_observed=(
            None if made.object is None else float(made.object.observed.float().mean())
        ),
        scene_points=len(made.scene.points),
        body={} if person is None else person.report,
        landmarks={
            name: {
                "found": int(one.found.sum()),
                "lost": one.fates.lost,
                "repaired": one.fates.repaired,
            }
            for name, one in made.people.people.items()
        },
        provenance=made.provenance,
        warnings=made.warnings,
        seconds=made.stages.seconds,
        registered=figures["registered"] / figures["images"] if "registered" in figures else None,
        reprojection_px=figures.get("reprojection_px"),
        displacement_px=figures.get("displacement_px"),
        sharpness=[round(value, 4) for value in made.video.sharpness],
        body_residuals_px=[] if person is None else _numbers(person.residuals.numpy(), 2),
        body_residual_m=None if person is None else _metres_off(person, made.cameras),
        further_people={
            name: {
                "body_residual_px": other.residual_px,
                "body_residual_m": _metres_off(other, made.cameras),
            }
            for name, other in list(made.people.people.items())[1:]
        },
        depth_residual=None if depth is None else depth.typical,
        depth_residuals=[] if depth is None else _numbers(depth.residual, 4),
        depth_against="" if depth is None else depth.against,
        **({} if made.object_made is None else _object_measures(made.object_made)),
        object_name=options.object,
        further_objects={
            other: {
                "object_observed": float(thing.track.observed.float().mean()),
                "object_scale_spread": thing.spread,
                **_object_measures(thing),
            }
            for other, thing in made.objects_made.items()
            if other != options.object
        },
        omega=angular_factor(made.cameras, middle_of_motion, made.video.fps),
        big_omega=full_factor(made.cameras, moving),
    )


def _metres_off(person: FittedBody, cameras: Sequence[Camera]) -> float:
    """The distance from the landmarks at the person's."""
    return round(person.residual_px * person.distance(cameras) / float(cameras[0].K[0, 0]), 4)


def _object_measures(made: MadeObject) -> dict[str, Any]:
    found = made.confidence
    return {
        "object_way": found.way,
        "object_reason": found.reason,
        "object_agreement": _numbers(found.agreement, 3),
        "object_iou": _numbers(made.ious, 3),
        "object_outline_m": _numbers(found.outline, 4),
        "object_held": found.held,
        "object_rests": found.rests,
        "hand_distance_m": _numbers(found.hand_distance, 4),
    }


def _numbers(values: Float[np.ndarray, " F"], digits: int) -> list[float | None]:
    """For JSON, which knows no NaN."""
    return [round(v, digits) if math.isfinite(v) else None for v in values.tolist()]
