"""Draft: everything that is known of a clip so far, from its source to its scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.estimator import FramePrompt
from hoigs.core.values.camera import Camera
from hoigs.preparation.body.body_files import FileBody
from hoigs.preparation.body.fit_problem import Observations
from hoigs.preparation.body.limbs import guessed_limbs
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.depth import DepthFit
from hoigs.preparation.estimates.reader import FoundObject, FrameEstimates, GivenMasks
from hoigs.preparation.final_masks import EntityMasks
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.objects.make_object import MadeObject
from hoigs.preparation.options import PrepareOptions, Prompt
from hoigs.preparation.people import Body, Unit
from hoigs.preparation.report.report import PrepareReport
from hoigs.preparation.scene_points import ScenePoints
from hoigs.preparation.video.frames import FrameList, Frames
from hoigs.preparation.video.source import Source
from hoigs.preparation.work_folder import WorkFolder

_LATER: Any = None  # of a field that a stage fills in


@dataclass(frozen=True)
class Draft:
    """A clip in the making; each stage returns it with more fields filled in.

    Attributes:
        source: where the inputs lie. out: the clip folder to be made. body: the model to fit.
        work: where stages keep their results. body_file: another program's body of the person.
        announce: called with what the user should read before a long stage.
        frames: the chosen ones. video: reads them; of frames with a camera alone, once cameras are
            known. clicks: prompts of the options, each with its frame.
        people: names of those who are fitted. boxes: of people whom no click shows. beside: of
            people who are followed and not fitted.
        estimates: landmarks and masks as found, distortion still in. found_object: masks of an
            estimator of objects alone.
        track: cameras in their own unit.
        undistorted: `estimates` on the cameras' images. ball: the object, if it was tracked as one.
        bodies: by name, the first person's first. unit: what turns the cameras' unit into metres.
        masks: disjoint, of everything. objects: by name, those that were seen.
        depth: an estimator's depth in metres. scene: points of what stands still.
        warnings: sentences for the report. provenance: what each part was made from.
        unknown: what the video does not show and is supposed, and why.
        keys: of stages that have run, what their results are stored under. seconds: by stage.
    """

    source: Source
    out: Path
    body: BodyModel
    work: WorkFolder
    body_file: FileBody | None = None
    announce: Callable[[str], object] = lambda _said: None
    frames: FrameList = _LATER
    video: Frames = _LATER
    clicks: Mapping[str, Prompt] = field(default_factory=dict)
    people: tuple[str, ...] = ()
    boxes: dict[str, FramePrompt] = field(default_factory=dict)
    beside: dict[str, FramePrompt] = field(default_factory=dict)
    estimates: FrameEstimates = _LATER
    found_object: FoundObject | None = None
    track: CameraTrack = _LATER
    undistorted: FrameEstimates = _LATER
    ball: BallTrack | None = None
    bodies: dict[str, Body] = field(default_factory=dict)
    unit: Unit = _LATER
    masks: EntityMasks = _LATER
    objects: dict[str, MadeObject] = field(default_factory=dict)
    depth: DepthFit | None = None
    scene: ScenePoints = _LATER
    report: PrepareReport = _LATER
    warnings: tuple[str, ...] = ()
    provenance: dict[str, str] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def noting(
        self,
        warnings: Iterable[str] = (),
        provenance: Mapping[str, str] | None = None,
        unknown: Mapping[str, str] | None = None,
        **fields: Any,
    ) -> Draft:
        """With more said of it, and fields filled in."""
        return replace(
            self,
            warnings=(*self.warnings, *warnings),
            provenance={**self.provenance, **(provenance or {})},
            unknown={**self.unknown, **(unknown or {})},
            **fields,
        )

    @property
    def prompts(self) -> dict[str, Prompt]:
        """Where, or what, each entity is: clicks, and boxes of people who were found."""
        found = {**self.boxes, **self.beside}
        boxes = {name: Prompt(box=at.box, frame=at.frame) for name, at in found.items()}
        return {**self.clicks, **boxes}

    @property
    def person(self) -> Body | None:
        """The first person's body."""
        return next(iter(self.bodies.values()), None)

    @cached_property
    def cameras(self) -> list[Camera]:
        """Of each frame, in metres."""
        return [camera.scaled(self.unit.metres) for camera in self.track.cameras]

    @cached_property
    def guessed(self) -> dict[str, dict[str, list[int]]]:
        """Of each person and limb, the frames in which its pose is a guess."""
        return {
            name: guessed_limbs(
                self.body, one.poses,
                self.undistorted.landmarks[name].without(~torch.from_numpy(one.found)),
                self.cameras, self.masks.moving,
            )
            for name, one in self.bodies.items()
        }  # fmt: skip

    def observations(self) -> dict[str, Observations]:
        """What each person's body is fitted to, the first one's first."""
        track, times = self.track, torch.tensor(self.video.times)
        found = {
            name: Observations(
                landmarks, track.cameras, times, points=None if track.metric else track.points,
                masks=self.undistorted.further.get(name),
            )
            for name, landmarks in self.undistorted.landmarks.items()
        }  # fmt: skip
        first = next(iter(found))
        file = self.body_file
        found[first] = replace(
            found[first],
            masks=self.undistorted.masks.persons(self.ball),
            turns=None if file is None else file.rotations(self.video.indices),
        )
        return found

    def images(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        """The frames anew, undistorted."""
        return (self.track.undistort.image(image) for image in self.video)

    def given_masks(self, options: PrepareOptions) -> GivenMasks:
        """Undistorted masks of the source, with those that were found of the object alone."""
        given, found = self.undistorted.masks, self.found_object
        if not options.find_object:
            return GivenMasks(human=given.persons(None), beside=given.beside)
        if found is None:
            return given
        undistort = self.track.undistort
        masks = MaskStack(undistort.mask(found.masks[i]) for i in self.track.positions)
        return replace(given, object=masks)

    def mask_of(self, name: str) -> MaskStack:
        """The final masks of a person or an object that the clip has."""
        if name in self.bodies:
            return self.masks.people.get(name, self.masks.human)
        return self.masks.further.get(name, self.masks.object)
