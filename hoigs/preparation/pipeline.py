"""One preparation: each method is a stage, whose result comes from the work folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import hoigs
from hoigs.core.body import LEFT_WRIST, RIGHT_WRIST, BodyModel
from hoigs.core.clip import BodyTrack, ObjectTrack
from hoigs.core.errors import HoigsError
from hoigs.preparation import saved
from hoigs.preparation.ball import BallTrack, load_ball, refine_ball
from hoigs.preparation.blank import blank_pixels
from hoigs.preparation.camera_choice import ChosenCameras, choose_cameras
from hoigs.preparation.cameras import scaled_cameras
from hoigs.preparation.clip_writing import write_clip_folder
from hoigs.preparation.depth import (
    POOR,
    DepthFit,
    DepthSource,
    fit_depth,
    seen_points,
    seen_surface,
)
from hoigs.preparation.evidence import Gathering, Priors, described, paths_of
from hoigs.preparation.frames import FrameList, open_frames
from hoigs.preparation.leftovers import Leftovers
from hoigs.preparation.masks import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.person import FittedBody, fit_person
from hoigs.preparation.plan import PLAN
from hoigs.preparation.report import PrepareReport
from hoigs.preparation.saved import EntityStacks, Inputs
from hoigs.preparation.scene import ScenePoints, colmap_scene, static_scene
from hoigs.preparation.silhouette import silhouette
from hoigs.preparation.source import Source
from hoigs.preparation.split_masks import entity_masks
from hoigs.preparation.stages import Stages
from hoigs.preparation.store import Result, WorkFolder, digest, fingerprint
from hoigs.preparation.things import make_object

FORMAT = 3  # of what the stages keep; another number makes older results unread
T = TypeVar("T")


class Pipeline:
    """One run. `run` goes through the stages in order; each sets what the next ones read."""

    def __init__(
        self,
        source: Source,
        out: Path,
        body: BodyModel,
        options: PrepareOptions,
        priors: Priors,
        stages: Stages,
        work: WorkFolder,
        leftovers: Leftovers,
    ) -> None:
        self.source, self.out, self.body = source, out, body
        self.options, self.stages, self.work = options, stages, work
        self.priors, self.leftovers = priors, leftovers
        self.warnings: list[str] = []
        self.provenance: dict[str, str] = {}
        self.worth_keeping = False
        self._keys: dict[str, str] = {}

    def run(self, until: str | None = None) -> None:
        """All stages, or those up to `until`; the last sets `report`."""
        for name in PLAN:
            getattr(self, f"_{name}")()
            if name == until:
                return

    def images(self) -> Iterable[np.ndarray]:
        """The frames anew, undistorted."""
        return (self.track.undistort.image(image) for image in self.video)

    def _stage(
        self,
        name: str,
        make: Callable[[], T],
        save: Callable[[T], Result],
        load: Callable[[Result], T],
        made_from: Any = None,
    ) -> T:
        """A stage's result as the work folder has it, made before if it is not there.

        It is read back even when it has just been made, so that a run that was taken up gives
        what an unbroken one gives.

        Args:
            made_from: JSON of whatever else the result depends on, beside PLAN's options.
        """
        key = self._keys[name] = self._key(name, made_from)
        with self.stages.stage(name):
            stored = self.work.load(name, key)
            if stored is None:
                warned, known = len(self.warnings), dict(self.provenance)
                made = save(make())
                notes: dict[str, Any] = {
                    "warnings": self.warnings[warned:],
                    "provenance": {k: v for k, v in self.provenance.items() if k not in known},
                    "seconds": self.stages.elapsed(),
                }
                values = {"made": made.values, "notes": notes}
                stored = self.work.save(
                    name, key, Result(values, made.arrays, made.files, made.folder)
                )
                self.worth_keeping |= PLAN[name].long
            else:
                notes = stored.values["notes"]
                self.warnings += notes["warnings"]
                self.provenance |= notes["provenance"]
            value = load(Result(stored.values["made"], stored.arrays, None, stored.folder))
        self.stages.seconds[name] = notes["seconds"]
        return value

    def _key(self, name: str, made_from: Any) -> str:
        options = self.options.model_dump(mode="json")
        stage = PLAN[name]
        return digest(
            {
                "format": [FORMAT, hoigs.__version__],
                "options": {key: options[key] for key in stage.options},
                "after": {other: self._keys[other] for other in stage.after},
                "from": made_from,
            }
        )

    def _frames(self) -> None:
        options, path = self.options, self.source.video

        def make() -> FrameList:
            frames = open_frames(
                path, options.width, options.every, options.max_frames, fps=options.fps,
                pick=options.pick, rate=options.folder_fps,
            )  # fmt: skip
            return frames.list

        found = self._stage(
            "frames", make, saved.save_frames, saved.load_frames, fingerprint([path])
        )
        self.video = open_frames(path, options.width, known=found)

    def _evidence(self) -> None:
        # all of it before the long work, so that what is wrong is said at once
        gathering = self.gathering = Gathering(
            self.source, self.video, self.options, self.priors, self.work.root / "priors"
        )
        self._without_dubious_depth()
        beside = self.source.beside
        used = {kind: prior for kind, prior in self.priors.items() if kind != "depth"}
        paths = [path for prior in used.values() for path in paths_of(prior, self.source.folder)]
        made_from = [
            fingerprint(paths),
            {kind: described(prior) for kind, prior in used.items()},
            self.source.masked,
        ]
        self.worth_keeping |= any(kind not in beside for kind in used)
        self.raw = self._stage(
            "evidence", lambda: gathering.gather(self.stages.advance), saved.save_evidence,
            saved.load_evidence, made_from,
        )  # fmt: skip

    def _without_dubious_depth(self) -> None:
        """Depth that nobody asked for, but which lies beside the video, must be in order."""
        if "depth" not in self.source.beside:
            return
        try:
            self.gathering.estimate("depth", lambda _done: None)
        except HoigsError as error:
            self.warnings.append(
                f"depth/ beside the video is not used (name it with --set "
                f"priors.depth.use=prior:depth-files and its settings, to use it): {error}"
            )
            self.priors = {k: prior for k, prior in self.priors.items() if k != "depth"}

    def _cameras(self) -> None:
        model = self.source.colmap
        files = None if model is None else [str(model), fingerprint([model])]
        folder = self.work.unfinished("cameras", self._key("cameras", files))
        chosen = self._stage(
            "cameras", lambda: self._choose_cameras(folder), saved.save_chosen, saved.load_chosen,
            files,
        )  # fmt: skip
        shutil.rmtree(folder, ignore_errors=True)
        self.track = chosen.track
        self.worth_keeping |= chosen.own_model
        if len(self.track.positions) < len(self.video):
            self.video = self.video.subset(self.track.positions)

    def _choose_cameras(self, folder: Path) -> ChosenCameras:
        chosen = choose_cameras(
            self.video, self.raw.landmarks, self.raw.masks, self.source.colmap, self.options,
            folder, self.stages.advance,
        )  # fmt: skip
        self.provenance["cameras"] = chosen.track.provenance
        self.warnings.extend(chosen.warnings)
        return chosen

    def _inputs(self) -> None:
        def make() -> Inputs:
            landmarks = self.raw.landmarks.straight(self.track)
            return Inputs(landmarks, self.raw.masks.straight(self.track), self._ball())

        ball = self.source.ball
        files = None if ball is None else fingerprint([ball])
        inputs = self._stage("inputs", make, saved.save_inputs, saved.load_inputs, files)
        self.landmarks, self.given, self.ball = inputs.landmarks, inputs.given, inputs.ball

    def _ball(self) -> BallTrack | None:
        if self.source.ball is None:
            return None
        rough = load_ball(self.source.ball, self.video, self.track.undistort)
        return refine_ball(rough, self.images())

    def _body(self) -> None:
        def make() -> FittedBody:
            person = fit_person(
                self.landmarks, self.track, self.body, self.options.fit_steps,
                self.stages.advance, self.raw.landmarks.source, self.given.persons(self.ball),
            )  # fmt: skip
            self.provenance["body"] = person.provenance
            self.warnings.extend(person.warnings)
            return person

        model = [type(self.body).__qualname__, self.body.num_betas, len(self.body.parents)]
        self.person = self._stage("body", make, saved.save_body, saved.load_body, model)
        self.cameras = scaled_cameras(self.track.cameras, self.person.scene_scale)

    def _masks(self) -> None:
        def make() -> EntityStacks:
            human, thing, text = entity_masks(
                self.given, self.ball, self.images, self._silhouettes, self.person.found
            )
            self.provenance["masks"] = text
            return EntityStacks(human, thing, self._blank(human, thing))

        self.masks = self._stage("masks", make, saved.save_masks, saved.load_masks)

    def _blank(self, humans: MaskStack, things: MaskStack) -> MaskStack:
        rows = zip(self.images(), humans, things, strict=True)
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

    def _object(self) -> None:
        self.object, self.spread = self._stage(
            "object", self._place_object, saved.save_object, saved.load_object
        )

    def _place_object(self) -> tuple[ObjectTrack, float]:
        wrists = self.person.joints[:, [LEFT_WRIST, RIGHT_WRIST]]
        track, spread = make_object(
            self.ball, self.masks.thing, self.cameras, wrists, self.images,
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

    def _depth(self) -> None:
        prior, self.depth_maps = self.priors.get("depth"), None
        made_from = None
        if prior is not None:
            made_from = [described(prior), fingerprint(paths_of(prior, self.source.folder))]
        self.depth = self._stage(
            "depth", self._fit_depth, saved.save_depth, saved.load_depth, made_from
        )
        if prior is not None and self.depth_maps is None:
            self.depth_maps = self._read_depth()

    def _read_depth(self) -> DepthSource:
        maps = self.gathering.estimate("depth", lambda _done: None).depth
        assert maps is not None  # `checked` saw to it
        return DepthSource(maps, self.video, self.track.undistort)

    def _fit_depth(self) -> DepthFit | None:
        if "depth" not in self.priors:
            return None
        self.depth_maps = self._read_depth()
        surfaces = [vertices for vertices, _ in self.person.posed(self.body)]
        points = self.track.points * self.person.scene_scale
        fit = fit_depth(
            self.depth_maps,
            lambda i: seen_points(points, self.cameras[i], self.moving(i)),
            lambda i: seen_surface(surfaces[i], self.cameras[i], self.masks.human[i]),
            len(self.video),
            self.stages.advance,
        )
        self.provenance["depth"] = fit.provenance
        if fit.typical > POOR:
            self.warnings.append(
                f"depth is {100 * fit.typical:.0f} % off {fit.against}: see the report"
            )
        return fit

    def moving(self, frame: int) -> np.ndarray:
        """Pixels of a frame that show no scene."""
        masks = self.masks
        return masks.human[frame] | masks.thing[frame] | masks.blank[frame]

    def metres(self, frame: int) -> np.ndarray | None:
        """Depth of a frame, 0 where it is unknown; None without a prior of depth."""
        if self.depth is None or self.depth_maps is None:
            return None
        return self.depth.metres(self.depth_maps[frame], frame)

    def _scene(self) -> None:
        self.scene = self._stage("scene", self._find_scene, saved.save_scene, saved.load_scene)

    def _find_scene(self) -> ScenePoints:
        masks = (self.masks.human, self.masks.thing, self.masks.blank)
        if not self.track.static:
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
                metres=None if self.depth is None else self._metres_of,
            )  # fmt: skip
            if self.depth is None:
                self.warnings.append(
                    "the camera stands still: the scene's depth is supposed, only what moves has a "
                    "measured place"
                )
        self.provenance["scene"] = scene.provenance
        return scene

    def _writing(self) -> None:
        self.report: PrepareReport = write_clip_folder(self)

    def _metres_of(self, frame: int) -> np.ndarray:
        depth = self.metres(frame)
        assert depth is not None
        return depth

    @property
    def body_track(self) -> BodyTrack:
        return BodyTrack(self.options.body, self.person.poses, self.provenance["body"])
