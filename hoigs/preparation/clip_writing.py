"""The last stage: frames, tracks and the report become a clip folder, which appears when whole."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.clip_folder.write import ClipWriter
from hoigs.core.interfaces.body import PELVIS
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import POSES_ESTIMATED, BodyTrack
from hoigs.core.values.world import World
from hoigs.preparation.cameras.camera_track import angular_factor, full_factor, parallax
from hoigs.preparation.depth import DepthSource
from hoigs.preparation.draft import Draft
from hoigs.preparation.objects.make_object import MadeObject
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.people import Body
from hoigs.preparation.report.measures import BodyWithin
from hoigs.preparation.report.object_seen import (
    DOUBTFUL,
    SEEN,
    ObjectSeen,
    best_click,
    by_state,
)
from hoigs.preparation.report.overlay import OverlayVideo, save_object_picture, several, shown_frame
from hoigs.preparation.report.report import PrepareReport
from hoigs.preparation.upright import world_of
from hoigs.preparation.video.source import SourceError

BODY_JOINTS = 22  # without the hands', which are not fitted


def write_clip_folder(
    draft: Draft,
    options: PrepareOptions,
    maps: DepthSource | None,
    progress: Callable[[float], None],
) -> Draft:
    """Writes and checks what the other stages made, and gives the folder its name; the draft with
    its report."""
    entities: dict[str, Literal["human", "object"]] = dict.fromkeys(draft.bodies, "human")
    entities |= dict.fromkeys(draft.objects, "object")
    if not entities:
        raise SourceError(
            "no object was found in a clip without people: point at it with --object X,Y"
        )
    cleanup = Cleanup(draft.out.absolute(), draft.work.root)
    with ClipWriter(
        draft.out, fps=draft.video.fps, entities=entities, image_format=options.image_format,
        quality=options.quality, depth_kind="none" if draft.depth is None else "metric",
        depth_dtype=np.float16,
    ) as writer:  # fmt: skip
        cleanup.register(writer.root)
        start = time.perf_counter()
        _write_frames(draft, options, maps, writer, progress)
        seconds = round(time.perf_counter() - start, 2)
        draft = replace(draft, seconds={**draft.seconds, "write": seconds})
        for name, person in draft.bodies.items():
            writer.set_body(name, BodyTrack(options.body, person.poses, person.provenance))
        for name, thing in draft.objects.items():
            writer.set_object(name, thing.track)
        writer.set_points(draft.scene.points, draft.scene.colors)
        world = world_of(draft, _focal_range(draft))
        writer.set_world(world)
        if world.is_guess:
            why = (
                "nobody stands, and no vertical lines are clear: the cameras are taken to be level"
            )
            draft = draft.noting(unknown={"up": why})
        if draft.video.uneven:
            writer.set_times(draft.video.times)
        if draft.track.model is not None:
            writer.set_colmap(draft.track.model)
        writer.provenance.update(
            draft.provenance,
            video=draft.source.video.name,
            frames=draft.video.indices,
            unknown=draft.unknown,
            **{POSES_ESTIMATED: True},
        )
        draft = replace(draft, report=_report(draft, options, writer.name, world))
        draft.report.save(writer.root)
    cleanup.remove()
    return draft


def _write_frames(
    draft: Draft,
    options: PrepareOptions,
    maps: DepthSource | None,
    writer: ClipWriter,
    progress: Callable[[float], None],
) -> None:
    picture = _object_picture(draft, options)
    people = [person.posed(draft.body) for person in draft.bodies.values()]
    stacks = {name: draft.mask_of(name) for name in (*draft.bodies, *draft.objects)}
    tracks = [made.track for made in draft.objects.values()]
    with OverlayVideo(
        writer.root / "overlay.mp4", draft.video.fps, options.overlay_width,
        several(draft.body.faces, len(people)),
    ) as overlay:  # fmt: skip
        rows = zip(draft.images(), draft.cameras, draft.masks.blank, strict=True)
        for i, (image, camera, blank) in enumerate(rows):
            vertices = torch.cat([torch.zeros(0, 3), *(next(one)[0] for one in people)])
            masks = {name: stack[i] for name, stack in stacks.items()}
            shown = [masks[name] for name in draft.bodies]
            human = np.logical_or.reduce([np.zeros_like(blank), *shown])
            depth = None if draft.depth is None or maps is None else draft.depth.metres(maps[i], i)
            writer.add_frame(image, camera, masks, depth, blank)
            objects = draft.masks.objects(i)
            if i == picture:
                save_object_picture(writer.root, image, objects)
            points = [t.points @ t.rotations[i].mT + t.translations[i] for t in tracks]
            points = [torch.zeros(0, 3), *points]
            overlay.add(image, camera, vertices, human, objects, torch.cat(points))
            progress((i + 1) / len(draft.video))


def _object_picture(draft: Draft, options: PrepareOptions) -> int | None:
    """Position of the frame that shows which object was taken; None where nobody had to choose."""
    if options.object_name not in draft.objects or draft.found_object is None:
        return None
    prompt = draft.prompts.get(options.object_name)
    prompted = [at.frame or 0 for at in prompt.places()] if prompt else []
    coverage = draft.masks.object.coverage().tolist()
    return shown_frame(draft.video.indices, draft.found_object.boxes, prompted, coverage)


def _report(draft: Draft, options: PrepareOptions, name: str, world: World) -> PrepareReport:
    middle = torch.median(draft.scene.points, dim=0).values
    person, figures, depth = draft.person, draft.track.figures, draft.depth
    joints = [one.joints[:, :BODY_JOINTS] for one in draft.bodies.values()]
    places = [thing.track.translations[:, None] for thing in draft.objects.values()]
    moving = torch.cat([*joints, *places], 1)
    middle_of_motion = moving[:, PELVIS]  # of the first person, or the first object
    measures = {
        held: {
            "object_observed": float(thing.track.observed.float().mean()),
            "object_scale_spread": thing.spread,
            **_object_measures(thing),
        }
        for held, thing in draft.objects.items()
    }
    first = measures.pop(
        options.object_name, {"object_observed": None, "object_scale_spread": None}
    )
    seen = _objects_seen(draft, options)
    return PrepareReport(
        name=name,
        video=draft.source.video.name,
        frames=len(draft.video),
        width=draft.cameras[0].width,
        height=draft.cameras[0].height,
        fps=draft.video.fps,
        camera=draft.track.kind,
        parallax_degrees=parallax(draft.cameras, middle),
        coverage={
            name: draft.mask_of(name).coverage().round(5).tolist()
            for name in (*draft.bodies, *draft.objects)
        },
        body_residual_px=None if person is None else person.residual_px,
        scene_scale=draft.unit.metres,
        scene_points=len(draft.scene.points),
        body={} if person is None else person.report,
        bodies_within={
            name: BodyWithin(
                _numbers(one.errors.joints.numpy(), 4),
                _numbers(one.errors.distance.numpy(), 4),
                round(one.distance(draft.cameras), 3),
                one.report["size_from"],
                one.unseen,
                draft.guessed[name],
            )
            for name, one in draft.bodies.items()
        },
        landmarks={
            name: {
                "found": int(one.found.sum()),
                "lost": one.fates.lost,
                "repaired": one.fates.repaired,
            }
            for name, one in draft.bodies.items()
        },
        provenance=draft.provenance,
        warnings=[*draft.warnings, *(s.doubt(name) for name, s in seen.items() if s.unexplained)],
        unknown=draft.unknown,
        seconds=draft.seconds,
        registered=figures["registered"] / figures["images"] if "registered" in figures else None,
        reprojection_px=figures.get("reprojection_px"),
        displacement_px=figures.get("displacement_px"),
        focal_px=round(_focal_of_video(draft), 1),
        focal_range=_focal_range(draft),
        up_known=world.known,
        up_within=world.within,
        sharpness=[round(value, 4) for value in draft.video.sharpness],
        body_residuals_px=[] if person is None else _numbers(person.residuals.numpy(), 2),
        body_residual_m=None if person is None else _metres_off(person, draft.cameras),
        further_people={
            name: {
                "body_residual_px": other.residual_px,
                "body_residual_m": _metres_off(other, draft.cameras),
            }
            for name, other in list(draft.bodies.items())[1:]
        },
        depth_residual=None if depth is None else depth.typical,
        depth_residuals=[] if depth is None else _numbers(depth.residual, 4),
        depth_against="" if depth is None else depth.against,
        **first,
        object_name=options.object_name,
        further_objects=measures,
        objects_seen=seen,
        omega=angular_factor(draft.cameras, middle_of_motion, draft.video.fps),
        big_omega=full_factor(draft.cameras, moving),
    )


def _focal_of_video(draft: Draft) -> float:
    """Pixels of the video, as --focal has them."""
    video = draft.video
    return float(draft.cameras[0].K[0, 0]) * video.native_width / video.width


def _focal_range(draft: Draft) -> tuple[float, float] | None:
    figures, pixels = draft.track.figures, _focal_of_video(draft)
    if "focal_low_px" not in figures:
        return None
    low, high = (figures[f"focal_{end}_px"] / pixels for end in ("low", "high"))
    return round(low, 3), round(high, 3)


def _objects_seen(draft: Draft, options: PrepareOptions) -> dict[str, ObjectSeen]:
    """By name of every object, in which frames it is seen, and how well it is placed."""
    seen = {}
    for name, thing in draft.objects.items():
        place, turn = errors_of(thing, draft.cameras)
        shown = thing.ious[np.isfinite(thing.ious)]
        overlap = float(shown.mean()) if len(shown) else None
        seen[name] = ObjectSeen(place_m=place, turn_degrees=turn, overlap=overlap)
        found = draft.found_object
        if found is not None and name != options.object_name:
            found = found.further.get(name)
        if found is None or not found.states or found.confidence is None:
            continue
        rows = list(draft.track.positions)
        states, sure = [found.states[i] for i in rows], found.confidence[rows].tolist()
        seen[name] = replace(seen[name], proposed=bool(found.boxes))
        if seen[name].unexplained:
            states = [DOUBTFUL if state == SEEN else state for state in states]
        click = best_click(states, sure, draft.video.indices)
        seen[name] = replace(seen[name], states=by_state(states), click=click)
    return seen


def errors_of(made: MadeObject, cameras: Sequence[Camera]) -> tuple[float | None, float | None]:
    """Metres by which an object's place is off, and degrees by which its turn is, typically.

    Across the picture it is off by as much as its outline is, and in depth by as much as its size
    seems to change. A turn out of the picture changes the outline to second order only: one that
    moves it by less than it is off, r (1 - cos a), cannot be told. It is not known at all where no
    texture shows it.
    """
    track, known = made.track, made.confidence.outline[np.isfinite(made.confidence.outline)]
    seen = track.observed.nonzero().flatten().tolist()
    if not seen:
        return None, None
    away = [float((track.translations[i] - cameras[i].center).norm()) for i in seen]
    outline = float(np.median(known)) if len(known) else 0.0
    place = math.hypot(outline, made.spread * float(np.median(away)))
    if made.confidence.way != "texture and hands":
        return place, None
    radius = float(track.points.norm(dim=-1).mean())
    return place, math.degrees(math.acos(max(0.0, 1 - outline / radius)))


def _metres_off(person: Body, cameras: Sequence[Camera]) -> float:
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


# Temporary folders beside a clip that a killed process left: the next run removes them.

RECORD = "writing.json"


class Cleanup:
    """Removes what the writing of one clip leaves beside it if the process is killed.

    Only folders are removed that a run registered before it filled them, or whose names and
    contents are those of a half-replaced clip.

    Args:
        clip: the folder to be made. work: the work folder, which one process at a time uses.
    """

    def __init__(self, clip: Path, work: Path) -> None:
        self.clip, self._record = clip, work / RECORD

    def register(self, temporary: Path) -> None:
        """To be called before anything large is in this temporary folder."""
        part = self._record.with_name("." + RECORD)
        part.write_text(json.dumps({"temporary": temporary.name}), encoding="utf-8")
        part.replace(self._record)

    def remove(self) -> None:
        """Removes the registered folder, if it is there, and clips that a new one has replaced."""
        beside = self.clip.parent
        if self._record.is_file():
            name = json.loads(self._record.read_text(encoding="utf-8"))["temporary"]
            folder = beside / name
            if name.startswith(f".{self.clip.name}.") and folder.is_dir():
                shutil.rmtree(folder)
            self._record.unlink()
        if self.clip.is_dir():
            for folder in beside.glob(f".{self.clip.name}.old.*"):
                if [p.name for p in folder.iterdir()] in ([], ["clip"]):
                    shutil.rmtree(folder)
