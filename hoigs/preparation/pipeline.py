"""One preparation: each method is a stage, whose result is kept in the work folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.model.standing import world_of_people
from hoigs.core.values.clip import BodyTrack
from hoigs.core.values.world import World
from hoigs.preparation.body.body_files import FileBody
from hoigs.preparation.body.mask_fit import silhouette
from hoigs.preparation.cameras.calibration import calibration_file
from hoigs.preparation.cameras.choose import ChosenCameras, choose_cameras, known_lens
from hoigs.preparation.choose_frames import choose_frames, stored_width
from hoigs.preparation.entities.final_masks import EntityMasks, blank_warning, final_masks
from hoigs.preparation.entities.people import FittedPeople, chosen_people, fit_people, nobody
from hoigs.preparation.entities.place_objects import place_objects
from hoigs.preparation.estimates.given import GivenMasks
from hoigs.preparation.estimates.reader import (
    EstimateReader,
    Estimators,
    FoundObject,
    RawEstimates,
    UndistortedEstimates,
    UndistortedPerson,
    identity,
    paths_of,
)
from hoigs.preparation.kept_stages import (
    KeptStages,
    from_result,
    load_cameras,
    save_cameras,
    to_result,
)
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.objects.ball import BallTrack, load_ball, refine_ball
from hoigs.preparation.objects.make_object import MadeObject
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prompts import check_prompts, placed_prompts
from hoigs.preparation.scene.depth import POOR, DepthFit, DepthSource
from hoigs.preparation.scene.metres import depth_in_metres, find_scene
from hoigs.preparation.scene.scene_points import ScenePoints
from hoigs.preparation.stages import PLAN, Stages
from hoigs.preparation.video.frames import FrameList, open_frames
from hoigs.preparation.video.source import NobodyFoundError, Source, SourceError
from hoigs.preparation.work_folder import Result, WorkFolder, fingerprint

T = TypeVar("T")


class Pipeline:
    """One run. `run` goes through the stages in order; each sets what the next ones read."""

    def __init__(
        self,
        source: Source,
        out: Path,
        body: BodyModel,
        options: PrepareOptions,
        estimators: Estimators,
        stages: Stages,
        work: WorkFolder,
        bodies: FileBody | None = None,
        announce: Callable[[str], object] = lambda _said: None,
    ) -> None:
        self.source, self.out, self.body = source, out, body
        self.options, self.stages, self.work = options, stages, work
        self.estimators, self.bodies, self.announce = estimators, bodies, announce
        self.kept = KeptStages(stages, work)
        self.warnings, self.provenance = self.kept.warnings, self.kept.provenance

    def run(self, until: str | None = None) -> None:
        """All stages but the writing of the clip, or those up to `until`."""
        for name in [name for name in PLAN if name != "writing"]:
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
        made_from: Any = None,
        save: Callable[[T], Result] = to_result,
        load: Callable[[Result], T] = from_result,
    ) -> T:
        """`KeptStages.run` with the options as they are now."""
        return self.kept.run(name, self._settings(), make, made_from, save, load, self._video_notes)

    def _settings(self) -> dict[str, Any]:
        return self.options.model_dump(mode="json")

    def _video_notes(self) -> Sequence[str]:
        return self.video.notes if hasattr(self, "video") else []

    def _frames(self) -> None:
        options, path = self.options, self.source.video

        def make() -> FrameList:
            found, notes = choose_frames(path, options)
            self.warnings += notes
            return found

        found = self._stage("frames", make, fingerprint([path]))
        self.options = placed_prompts(options, found)
        check_prompts(self.options, found)
        width = options.width
        if width is None:
            width, notes = stored_width(found)
            self.warnings += notes
        self.video = open_frames(path, width, known=found)
        known_lens(self.options, self.video)  # before anything slow

    def _evidence(self) -> None:
        # all estimates before the slow stages, so that errors in them are reported at once
        self.reader = EstimateReader(
            self.source, self.video, self.options, self.estimators, self.work.root / "estimators"
        )
        self._without_unusable_depth()
        self._choose_people()
        try:
            self.raw = self._people_and_masks()
        except NobodyFoundError as error:
            if self.options.object not in self.options.prompts or not self.options.find_object:
                self.kept.worth_keeping = False
                raise
            said = f"{error}; so the clip has the object alone (--person X,Y@FRAME shows somebody)"
            self.announce(said)
            self.warnings.append(said)
            self.options = self.options.model_copy(update={"find_person": False})
            self.reader = replace(self.reader, options=self.options)
            self.raw = self._people_and_masks()
        self.warnings += self.reader.notes_on_person()

    def _people_and_masks(self) -> RawEstimates:
        beside = self.source.beside
        used = {k: e for k, e in self.estimators.items() if k in ("landmarks", "masks")}
        paths = [
            path for estimator in used.values() for path in paths_of(estimator, self.source.folder)
        ]
        made_from = [
            fingerprint(paths),
            {kind: identity(estimator) for kind, estimator in used.items()},
            self.source.masked,
            self.reader.of_both,
            self._prompts(*((self.options.object,) if self.reader.of_both else ())),
        ]
        self.kept.worth_keeping |= any(kind not in beside for kind in used)
        return self._stage(
            "evidence", lambda: self.reader.landmarks_and_masks(self.stages.advance), made_from
        )

    def _choose_people(self) -> None:
        """Takes one of several people, or all, where nobody was clicked on, and says so first."""
        people, prompts = self.options.people, self.options.prompts
        if not people or any(name in prompts for name in people):
            return
        self.options, said = chosen_people(self.options, self.reader.people())
        if said:
            self.announce(said)
            self.warnings.append(said)
            self.reader = replace(self.reader, options=self.options)

    def _prompts(self, *names: str) -> dict[str, Any]:
        """The prompts of people and of `names`, as JSON."""
        prompts = self.options.prompts
        wanted = (*self.options.people, *names)
        return {n: prompts[n].model_dump(mode="json") for n in wanted if n in prompts}

    def _object_masks(self) -> None:
        estimator = self.estimators.get("object")
        made_from = None
        if estimator is not None:
            files = fingerprint(paths_of(estimator, self.source.folder))
            made_from = [identity(estimator), files, self._prompts(*self.options.objects)]
        self.found_object = self._stage("object_masks", self._find_object, made_from)

    def _find_object(self) -> FoundObject | None:
        if "object" not in self.estimators:
            if self.options.further_objects:
                raise SourceError(
                    f"{len(self.options.objects)} objects are given, "
                    f"{' and '.join(self.options.objects)}; an estimator that follows them is "
                    "needed: leave out the masks beside the video, and use --estimators offline"
                )
            return None
        found = self.reader.object_masks(self.stages.advance)
        self.warnings += found.notes
        return found

    def _without_unusable_depth(self) -> None:
        """Leaves out depth maps beside the video that were not requested and cannot be used."""
        if "depth" not in self.source.beside:
            return
        try:
            self.reader.estimate("depth", lambda _done: None)
        except HoigsError as error:
            self.warnings.append(
                f"depth/ beside the video is not used (name it with --set "
                f"estimators.depth.use=estimator:depth-files and its settings, to use it): {error}"
            )
            self.estimators = {
                k: estimator for k, estimator in self.estimators.items() if k != "depth"
            }

    def _cameras(self) -> None:
        calibration = self.options.calibration
        lens = None if calibration is None else calibration_file(calibration)[0]
        known = [p for p in (self.source.colmap, self.source.cameras, lens) if p is not None]
        known += [] if self.bodies is None else [self.bodies.path]
        files = [[str(path), fingerprint([path])] for path in known]
        folder = self.work.unfinished("cameras", self.kept.key("cameras", self._settings(), files))
        chosen = self._stage(
            "cameras", lambda: self._choose_cameras(folder), files, save_cameras, load_cameras
        )
        shutil.rmtree(folder, ignore_errors=True)
        self.track = chosen.track
        self.kept.worth_keeping |= chosen.own_model
        if len(self.track.positions) < len(self.video):
            self.video = self.video.subset(self.track.positions)

    def _choose_cameras(self, folder: Path) -> ChosenCameras:
        chosen = choose_cameras(
            self.video, self.raw.landmarks, self.raw.masks, self.source.colmap, self.options,
            folder, self.stages.advance, self.source.cameras, self.bodies,
        )  # fmt: skip
        self.provenance["cameras"] = chosen.track.provenance
        self.warnings.extend(chosen.warnings)
        return chosen

    def _inputs(self) -> None:
        def make() -> UndistortedEstimates:
            raw, placed = self.raw, (self.track.undistort, self.track.positions)
            undistort, rows = placed
            return UndistortedEstimates(
                None if raw.landmarks is None else raw.landmarks.undistorted(*placed),
                raw.masks.undistorted(*placed),
                self._ball(),
                {
                    name: UndistortedPerson(
                        person.landmarks.undistorted(*placed),
                        MaskStack(undistort.mask(person.masks[i]) for i in rows),
                    )
                    for name, person in raw.further.items()
                },
            )

        ball = self.source.ball
        files = None if ball is None else fingerprint([ball])
        self.estimates = self._stage("inputs", make, files)

    def _ball(self) -> BallTrack | None:
        if self.source.ball is None or not self.options.find_object:
            return None
        rough = load_ball(self.source.ball, self.video, self.track.undistort)
        return refine_ball(rough, self.images())

    def _body(self) -> None:
        model: list[Any] = [
            type(self.body).__qualname__, self.body.num_betas, len(self.body.parents)
        ]  # fmt: skip
        if self.bodies is not None:
            model.append(fingerprint([self.bodies.path]))
        if not self.options.people:  # its size is the unit
            model.append(self.kept.key_of("object_masks"))
        self.people: FittedPeople = self._stage("body", self._fit_people, model)
        scale = self.people.world.scene_scale
        self.cameras = [camera.scaled(scale) for camera in self.track.cameras]

    def _fit_people(self) -> FittedPeople:
        if not self.options.people:
            world = nobody(self._given_masks().object, self.track, self.options.object_size)
            found = FittedPeople({}, world)
            self.provenance["body"] = world.provenance
        else:
            fitted = fit_people(
                self.options.people, self.estimates, self.raw, self.track, self.body,
                self.options, self.video, self.bodies, self.stages.advance,
            )  # fmt: skip
            found = FittedPeople(fitted)
            for k, (name, person) in enumerate(fitted.items()):
                self.provenance[f"body {name}" if k else "body"] = person.provenance
        self.warnings += found.warnings()
        return found

    def _masks(self) -> None:
        def make() -> EntityMasks:
            masks, self.provenance["masks"] = final_masks(
                self._given_masks(), self.estimates, self.people, self.found_object, self.track,
                self.images, self._silhouettes, keep_black=self.options.keep_black,
                folder=self.work.root,
            )  # fmt: skip
            self.warnings += blank_warning(masks.blank)
            return masks

        self.masks = self._stage("masks", make)

    def _given_masks(self) -> GivenMasks:
        """The source's masks with those that were found of the object alone, undistorted."""
        given, found = self.estimates.masks, self.found_object
        if not self.options.find_object:
            return GivenMasks(human=given.persons(None))
        if found is None:
            return given
        undistort = self.track.undistort
        masks = MaskStack(undistort.mask(found.masks[i]) for i in self.track.positions)
        return replace(given, object=masks)

    def _silhouettes(self) -> MaskStack:
        assert self.people.first is not None  # masks of nobody are not separated
        pairs = zip(self.people.first.posed(self.body), self.cameras, strict=True)
        return MaskStack(silhouette(v, self.body.faces, c) for (v, _), c in pairs)

    def _object(self) -> None:
        self.objects_made = self._stage("object", self._place_objects)
        self.object_made = self.objects_made.get(self.options.object)
        self.object = None if self.object_made is None else self.object_made.track

    def _place_objects(self) -> dict[str, MadeObject]:
        placed = place_objects(
            self.masks, self.estimates, self.people, self.cameras, self.body.parents, self.images,
            self.options, self.video.fps, self.stages.advance,
        )  # fmt: skip
        self.provenance |= placed.provenance
        self.warnings += placed.warnings
        return placed.objects

    def _depth(self) -> None:
        estimator, self.depth_maps = self.estimators.get("depth"), None
        made_from = None
        if estimator is not None:
            made_from = [identity(estimator), fingerprint(paths_of(estimator, self.source.folder))]
        self.depth = self._stage("depth", self._fit_depth, made_from)
        if estimator is not None and self.depth_maps is None:
            self.depth_maps = self._read_depth()

    def _read_depth(self) -> DepthSource:
        maps = self.reader.estimate("depth", lambda _done: None).depth
        assert maps is not None  # `checked` saw to it
        return DepthSource(maps, self.video, self.track.undistort)

    def _fit_depth(self) -> DepthFit | None:
        if "depth" not in self.estimators:
            return None
        self.depth_maps = self._read_depth()
        fit = depth_in_metres(
            self.depth_maps, self.people, self.body, self.track, self.cameras, self.masks,
            self.stages.advance,
        )  # fmt: skip
        self.provenance["depth"] = fit.provenance
        if fit.typical > POOR:
            self.warnings.append(
                f"depth is {100 * fit.typical:.0f} % off {fit.against}: see the report"
            )
        return fit

    def metres(self, frame: int) -> np.ndarray | None:
        """Depth of a frame, 0 where it is unknown; None without an estimator of depth."""
        if self.depth is None or self.depth_maps is None:
            return None
        return self.depth.metres(self.depth_maps[frame], frame)

    def _scene(self) -> None:
        self.scene = self._stage("scene", self._find_scene)

    def _find_scene(self) -> ScenePoints:
        metres = None if self.depth is None else self._metres_of
        scene = find_scene(
            self.people, self.track, self.cameras, self.masks, self.images, self.options, metres
        )
        if self.track.static and self.depth is None:
            self.warnings.append(
                "the camera stays in one place: the scene's depth is supposed, only what moves "
                "has a measured place"
            )
        self.provenance["scene"] = scene.provenance
        return scene

    def _metres_of(self, frame: int) -> np.ndarray:
        depth = self.metres(frame)
        assert depth is not None
        return depth

    def object_masks(self, name: str) -> MaskStack:
        """The final masks of an object."""
        return self.masks.object if name == self.options.object else self.masks.further[name]

    def world(self) -> World:
        """Up and floor by the people who stand, else by the cameras."""
        people = [(self.body, person.poses) for person in self.people.people.values()]
        found = world_of_people(people, self.video.fps) if people else None
        return World.guessed(self.cameras) if found is None else found

    def people_masks(self) -> dict[str, MaskStack]:
        """The final masks of everybody."""
        names = list(self.people.people)
        return dict(zip(names, (self.masks.human, *self.masks.people.values()), strict=False))

    def body_tracks(self) -> dict[str, BodyTrack]:
        """Everybody's poses."""
        return {
            name: BodyTrack(self.options.body, person.poses, person.provenance)
            for name, person in self.people.people.items()
        }
