"""The last stage: frames, tracks and the report into the clip folder, which appears when whole."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

from hoigs.core.clip_folder import ClipWriter
from hoigs.preparation.cameras import parallax
from hoigs.preparation.overlay import OverlayVideo
from hoigs.preparation.report import PrepareReport

if TYPE_CHECKING:
    from hoigs.preparation.pipeline import Pipeline


def write_clip_folder(made: Pipeline) -> PrepareReport:
    """Writes what the other stages made, checks it and gives it its name."""
    options = made.options
    entities: dict[str, Literal["human", "object"]] = {
        options.human: "human",
        options.object: "object",
    }
    with ClipWriter(
        made.out, fps=made.video.fps, entities=entities, image_format=options.image_format,
        quality=options.quality,
    ) as writer:  # fmt: skip
        made.leftovers.note(writer.root)
        with made.stages.stage("writing"):
            _write_frames(made, writer)
        writer.set_body(options.human, made.body_track)
        writer.set_object(options.object, made.object)
        writer.set_points(made.scene.points, made.scene.colors)
        if made.track.model is not None:
            writer.set_colmap(made.track.model)
        writer.provenance.update(
            made.provenance, video=made.source.video.name, frames=made.video.indices
        )
        report = _report(made, writer.name)
        report.save(writer.root)
    made.leftovers.remove()
    return report


def _write_frames(made: Pipeline, writer: ClipWriter) -> None:
    options = made.options
    overlay = OverlayVideo(
        writer.root / "overlay.mp4", made.video.fps, options.overlay_width, made.body.faces
    )
    with overlay:
        rows = zip(
            made.images(), made.cameras, made.masks.human, made.masks.thing, made.masks.blank,
            made.person.posed(made.body), strict=True,
        )  # fmt: skip
        for i, (image, camera, human, thing, blank, (vertices, _)) in enumerate(
            made.stages.track(rows, len(made.video))
        ):
            masks = {options.human: human, options.object: thing}
            writer.add_frame(image, camera, masks, ignored=blank)
            points = made.object.points @ made.object.rotations[i].mT
            points = points + made.object.translations[i]
            overlay.add(image, camera, vertices, human, thing, points)


def _report(made: Pipeline, name: str) -> PrepareReport:
    middle = torch.median(made.scene.points, dim=0).values
    options, person = made.options, made.person
    coverage = {options.human: made.masks.human, options.object: made.masks.thing}
    return PrepareReport(
        name=name,
        video=made.source.video.name,
        frames=len(made.video),
        width=made.video.width,
        height=made.video.height,
        fps=made.video.fps,
        camera="static" if made.track.static else "moving",
        parallax_degrees=parallax(made.cameras, middle),
        coverage={n: m.coverage().round(5).tolist() for n, m in coverage.items()},
        body_residual_px=person.residual_px,
        scene_scale=person.scene_scale,
        object_scale_spread=made.spread,
        object_observed=float(made.object.observed.float().mean()),
        scene_points=len(made.scene.points),
        body=person.report,
        provenance=made.provenance,
        warnings=made.warnings,
        seconds=made.stages.seconds,
    )
