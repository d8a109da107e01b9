"""prepare: a video and what is known of it in, a clip folder with a written report out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from hoigs.core.body import LEFT_WRIST, RIGHT_WRIST, BodyModel
from hoigs.core.clip import BodyTrack, ObjectTrack
from hoigs.core.clip_folder import ClipWriter, check_clip, refuse_to_overwrite
from hoigs.core.clip_format import is_clip_folder
from hoigs.core.errors import ClipError
from hoigs.preparation.ball import BallTrack, load_ball, refine_ball
from hoigs.preparation.blank import blank_pixels
from hoigs.preparation.cameras import (
    CameraTrack,
    colmap_cameras,
    parallax,
    scaled_cameras,
    static_cameras,
)
from hoigs.preparation.frames import VideoFrames
from hoigs.preparation.masks import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.overlay import OverlayVideo
from hoigs.preparation.person import FittedBody, fit_person, load_landmarks
from hoigs.preparation.report import PrepareReport
from hoigs.preparation.scene import ScenePoints, colmap_scene, static_scene
from hoigs.preparation.silhouette import silhouette
from hoigs.preparation.source import Source, SourceError, find_source
from hoigs.preparation.split_masks import entity_masks, read_masks
from hoigs.preparation.stages import Progress, Stages
from hoigs.preparation.things import make_object

__all__ = ["PrepareOptions", "PrepareReport", "prepare"]

STAGES = {
    "frames": 2.0, "cameras": 1.0, "inputs": 6.0, "body": 40.0, "masks": 10.0, "object": 4.0,
    "scene": 6.0, "writing": 40.0,
}  # fmt: skip


def prepare(
    source: str | Path,
    out: str | Path,
    *,
    body: BodyModel,
    options: PrepareOptions | None = None,
    progress: Progress | None = None,
) -> PrepareReport:
    """Turn a source folder into a clip folder.

    Args:
        source: a folder with a video and its priors (see `find_source`), or the video in it.
        out: the clip folder to make, with report.json, report.md and overlay.mp4 in it; it
            appears when it is whole.
        body: the model to fit; `options.body` is its key.
        progress: called with 0..1 and the stage's name.

    Raises:
        SourceError: an input is absent, unreadable or does not fit the others.
        ClipError: `out` is there already.
    """
    options = options or PrepareOptions()
    _check_paths(Path(source), Path(out), options)
    found = find_source(Path(source), human=options.human, object_name=options.object)
    return _Preparation(found, Path(out), body, options, Stages(STAGES, progress)).run()


def _check_paths(source: Path, out: Path, options: PrepareOptions) -> None:
    if source.is_dir() and is_clip_folder(source):
        problems = len(check_clip(source))
        state = f"with {problems} problems" if problems else "and whole: train on it"
        raise SourceError(f"{source} is a clip already, {state}")
    refuse_to_overwrite(out)
    if is_clip_folder(out) and not options.overwrite:
        raise ClipError(f"{out} holds a clip already; choose another name or pass --overwrite")


class _Preparation:
    """One run; each method is a stage."""

    def __init__(
        self, source: Source, out: Path, body: BodyModel, options: PrepareOptions, stages: Stages
    ) -> None:
        self.source, self.out, self.body = source, out, body
        self.options, self.stages = options, stages
        self.warnings: list[str] = []
        self.provenance: dict[str, str] = {}

    def run(self) -> PrepareReport:
        options = self.options
        with self.stages.stage("frames"):
            self.video = VideoFrames(
                self.source.video, options.width, options.every, options.max_frames
            )
        with self.stages.stage("cameras"):
            self.track = self._cameras()
        with self.stages.stage("inputs"):
            # all of them before the long work, so that what is wrong is said at once
            self.landmarks = load_landmarks(self.source.landmarks, self.video, self.track)
            self.given = read_masks(
                self.source, self.video, self.track.undistort, (options.human, options.object)
            )
            self.ball = self._ball()
        with self.stages.stage("body"):
            self.person = self._person()
        with self.stages.stage("masks"):
            self.human, self.things = self._masks()
            self.blank = self._blank()
        with self.stages.stage("object"):
            self.object, self.spread = self._object()
        with self.stages.stage("scene"):
            self.scene = self._scene()
        return self._write()

    def images(self) -> Iterable[np.ndarray]:
        """The frames anew, undistorted."""
        return (self.track.undistort.image(image) for image in self.video)

    def _cameras(self) -> CameraTrack:
        if self.source.colmap is not None:
            track = colmap_cameras(self.video, self.source.colmap)
        else:
            track = static_cameras(self.video, self.options.focal)
            if self.options.focal is None:
                self.warnings.append(
                    "the focal length is assumed, and every depth is proportional to it: give "
                    "--focal if you know it"
                )
        self.provenance["cameras"] = track.provenance
        return track

    def _person(self) -> FittedBody:
        person = fit_person(
            self.landmarks, self.video, self.track, self.body, self.options.fit_steps,
            self.stages.advance,
        )  # fmt: skip
        self.cameras = scaled_cameras(self.track.cameras, person.scene_scale)
        self.provenance["body"] = person.provenance
        self.warnings += person.warnings
        return person

    def _ball(self) -> BallTrack | None:
        if self.source.ball is None:
            return None
        rough = load_ball(self.source.ball, self.video, self.track.undistort)
        return refine_ball(rough, self.images())

    def _masks(self) -> tuple[MaskStack, MaskStack]:
        human, things, text = entity_masks(
            self.given, self.ball, self.images, self._silhouettes, self.person.found
        )
        self.provenance["masks"] = text
        return human, things

    def _blank(self) -> MaskStack:
        rows = zip(self.images(), self.human, self.things, strict=True)
        if self.options.keep_black:
            return MaskStack(np.zeros_like(human) for _, human, _ in rows)
        blank = MaskStack(blank_pixels(image, human | thing) for image, human, thing in rows)
        coverage = blank.coverage()
        if coverage.any():
            self.warnings.append(
                f"{int((coverage > 0).sum())} frames have flat black patches, up to "
                f"{100 * coverage.max():.1f} % of the image, which show no scene: they are left "
                "out of training and scores (--keep-black if they are real)"
            )
        return blank

    def _silhouettes(self) -> MaskStack:
        pairs = zip(self.person.posed(self.body), self.cameras, strict=True)
        return MaskStack(silhouette(v, self.body.faces, c) for (v, _), c in pairs)

    def _object(self) -> tuple[ObjectTrack, float]:
        wrists = self.person.joints[:, [LEFT_WRIST, RIGHT_WRIST]]
        track, spread = make_object(
            self.ball, self.things, self.cameras, wrists, self.images,
            radius=self.options.ball_radius, count=self.options.object_points,
        )  # fmt: skip
        self.provenance["object"] = track.provenance
        lost = (~track.observed).nonzero().flatten().tolist()
        if lost:
            shown = ", ".join(map(str, lost[:12])) + (", …" if len(lost) > 12 else "")
            self.warnings.append(f"the object is not seen in {len(lost)} frames: {shown}")
        if self.ball is None:
            self.warnings.append(
                "of the object's rotation only the roll is known, and its shape is a cushion "
                "inflated from one outline: training has to find both"
            )
        return track, spread

    def _scene(self) -> ScenePoints:
        masks = (self.human, self.things, self.blank)
        if not self.source.static_camera:
            scale = self.person.scene_scale
            scene = colmap_scene(
                self.track.points * scale, self.track.colors, masks, self.cameras, self.images,
                self.options.scene_points,
            )  # fmt: skip
        else:
            scene = static_scene(
                self.images, masks, self.cameras[0],
                ground=self.person.ground, distance=self.person.distance(self.cameras),
                backdrop=self.options.backdrop, count=self.options.scene_points,
            )  # fmt: skip
            self.warnings.append(
                "the camera stands still: the scene's depth is supposed, only what moves has a "
                "measured place"
            )
        self.provenance["scene"] = scene.provenance
        return scene

    def _write(self) -> PrepareReport:
        options = self.options
        entities: dict[str, Literal["human", "object"]] = {
            options.human: "human",
            options.object: "object",
        }
        with ClipWriter(
            self.out, fps=self.video.fps, entities=entities, image_format=options.image_format,
            quality=options.quality,
        ) as writer:  # fmt: skip
            with self.stages.stage("writing"):
                self._write_frames(writer)
            writer.set_body(
                options.human,
                BodyTrack(options.body, self.person.poses, self.provenance["body"]),
            )
            writer.set_object(options.object, self.object)
            writer.set_points(self.scene.points, self.scene.colors)
            if self.source.colmap is not None:
                writer.set_colmap(self.source.colmap)
            writer.provenance.update(
                self.provenance, video=self.source.video.name, frames=self.video.indices
            )
            report = self._report(writer.name)
            report.save(writer.root)
        return report

    def _write_frames(self, writer: ClipWriter) -> None:
        overlay = OverlayVideo(
            writer.root / "overlay.mp4", self.video.fps, self.options.overlay_width, self.body.faces
        )
        with overlay:
            bodies = self.person.posed(self.body)
            rows = zip(
                self.images(), self.cameras, self.human, self.things, self.blank, bodies,
                strict=True,
            )  # fmt: skip
            for i, (image, camera, human, thing, blank, (vertices, _)) in enumerate(
                self.stages.track(rows, len(self.video))
            ):
                masks = {self.options.human: human, self.options.object: thing}
                writer.add_frame(image, camera, masks, ignored=blank)
                points = self.object.points @ self.object.rotations[i].mT
                points = points + self.object.translations[i]
                overlay.add(image, camera, vertices, human, thing, points)

    def _report(self, name: str) -> PrepareReport:
        middle = torch.median(self.scene.points, dim=0).values
        options = self.options
        coverage = {options.human: self.human, options.object: self.things}
        return PrepareReport(
            name=name,
            video=self.source.video.name,
            frames=len(self.video),
            width=self.video.width,
            height=self.video.height,
            fps=self.video.fps,
            camera="static" if self.source.static_camera else "moving",
            parallax_degrees=parallax(self.cameras, middle),
            coverage={n: m.coverage().round(5).tolist() for n, m in coverage.items()},
            body_residual_px=self.person.residual_px,
            scene_scale=self.person.scene_scale,
            object_scale_spread=self.spread,
            object_observed=float(self.object.observed.float().mean()),
            scene_points=len(self.scene.points),
            body=self.person.report,
            provenance=self.provenance,
            warnings=self.warnings,
            seconds=self.stages.seconds,
        )
