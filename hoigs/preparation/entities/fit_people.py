"""The body of everybody in a clip, one after another, in one world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch

from hoigs.core.interfaces.body import BodyModel
from hoigs.preparation.bodies.file_body import FileBody
from hoigs.preparation.body.landmarks import FrameFates
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.entities.person import FittedBody, fit_person
from hoigs.preparation.estimates.given import RawLandmarks
from hoigs.preparation.estimates.reader import RawEstimates, UndistortedEstimates
from hoigs.preparation.options.prepare_options import PrepareOptions
from hoigs.preparation.video.frames import Frames


def fit_people(
    names: Sequence[str],
    found: UndistortedEstimates,
    raw: RawEstimates,
    track: CameraTrack,
    body: BodyModel,
    options: PrepareOptions,
    video: Frames,
    bodies: FileBody | None,
    progress: Callable[[float], None],
) -> dict[str, FittedBody]:
    """Bodies by name. The first one's gives a world without scale its unit; the others stand in it.

    Args:
        bodies: of another program, of the first person.
    """
    first, *further = names
    times = torch.tensor(video.times)
    assert found.landmarks is not None and raw.landmarks is not None  # somebody is looked for
    share = partial(_share, progress, len(names))
    fitted = fit_person(
        found.landmarks, track, body, options.fit_steps, partial(share, 0), raw.landmarks.source,
        found.masks.persons(found.ball), times,
        None if bodies is None else bodies.rotations(video.indices), options.person_height,
        options.chunking, fates=_of_clip(raw.landmarks, track),
    )  # fmt: skip
    if bodies is not None:
        text = f"{fitted.provenance}; {bodies.used(video.indices)}"
        fitted = replace(fitted, provenance=text)
    people, world = {first: fitted}, _in_metres(track, fitted.scene_scale)
    for k, name in enumerate(further):
        person = found.further[name]
        people[name] = fit_person(
            person.landmarks, world, body, options.fit_steps, partial(share, k + 1),
            raw.further[name].landmarks.source, person.masks, times,
            chunking=options.chunking, fates=_of_clip(raw.further[name].landmarks, track),
        )  # fmt: skip
    return people


def _of_clip(landmarks: RawLandmarks, track: CameraTrack) -> FrameFates:
    """Of the frames that have a camera."""
    fates = landmarks.fates
    return FrameFates.at(fates.lost, fates.repaired, track.positions)


def _share(progress: Callable[[float], None], count: int, number: int, done: float) -> None:
    """The progress of one of several equal works."""
    progress((number + done) / count)


def _in_metres(track: CameraTrack, scale: float) -> CameraTrack:
    if track.metric:
        return track
    cameras = [camera.scaled(scale) for camera in track.cameras]
    return replace(track, cameras=cameras, points=scale * track.points, metric=True)
