"""The stages of a preparation: each takes the draft of a clip, and returns it with more in it.

`frames, estimates, object_masks, cameras, people, masks, objects, scene` and `write` run in this
order. The cameras stand behind the landmarks and masks because a focal length may be estimated from
a person, and because what moves by itself must not be taken for a moving camera.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import PromptError
from hoigs.core.reporting import Progress, ranges
from hoigs.preparation.body.mask_fit import silhouette
from hoigs.preparation.cameras.calibration import calibration_file
from hoigs.preparation.cameras.choose import (
    BesideVideo,
    choose_cameras,
    known_lens,
    without_covered,
)
from hoigs.preparation.clip_writing import write_clip_folder
from hoigs.preparation.depth import POOR, DepthSource, fit_depth, seen_points, seen_surface
from hoigs.preparation.draft import Draft
from hoigs.preparation.estimates.reader import EstimateReader, Estimators, identity, paths_of
from hoigs.preparation.final_masks import MaskSources, blank_warning, final_masks
from hoigs.preparation.kept import PLAN, kept, key_of
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.ball import load_ball, refine_ball
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.hands import nearest_person
from hoigs.preparation.objects.make_object import MadeObject, doubts, make_object
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.people import (
    chosen_people,
    fit_people,
    people_warnings,
    unit_of_object,
)
from hoigs.preparation.prompts import check_prompts, placed_prompts
from hoigs.preparation.scene_points import camera_scene, static_scene
from hoigs.preparation.video.container import missing_frames
from hoigs.preparation.video.frames import Choice, FrameList, Frames, open_frames
from hoigs.preparation.video.source import NobodyFoundError, SourceError
from hoigs.preparation.video.span import Span
from hoigs.preparation.work_folder import fingerprint

Advance = Callable[[float], None]  # called with the done fraction of a stage


def run(
    draft: Draft,
    options: PrepareOptions,
    estimators: Estimators,
    progress: Progress,
    until: str | None = None,
) -> Draft:
    """The draft after all stages, or those up to `until`; `progress` is of the whole."""
    total, done = sum(stage.weight for stage in PLAN.values()), 0.0
    for name, stage in STAGES.items():
        progress(done, name)
        share = PLAN[name].weight / total
        draft = stage(draft, options, estimators, partial(_advance, progress, name, done, share))
        done += share
        progress(done, name)
        if name == until:
            break
    return draft


def _advance(progress: Progress, name: str, before: float, share: float, done: float) -> None:
    progress(before + share * done, name)


def frames(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Chooses frames and opens the video; clicks and lens are checked before anything slow."""
    path, make = draft.source.video, partial(choose_frames, draft, options)
    found = kept(draft, "frames", options, make, fingerprint([path]))
    clicks = placed_prompts(options.prompts, found.frames)
    check_prompts(clicks, found.frames)
    width, notes = (options.width, []) if options.width else stored_width(found.frames)
    video = open_frames(path, width, known=found.frames)
    known_lens(options, video)
    return found.noting(notes, video=video, clicks=clicks)


NEARLY_BLACK = 16  # of 255
PROBES = 5  # frames, one of which must show something


def require_pictures(frames: Frames) -> None:
    """That a video shows something.

    Raises:
        SourceError: some frames from all over it are all black.
    """
    places = np.linspace(0, len(frames) - 1, min(PROBES, len(frames))).round().astype(int)
    brightest = 0
    for place in places.tolist():  # the first one settles it for nearly every video
        brightest = max(brightest, int(np.quantile(frames.read(frames.indices[place]), 0.99)))
        if brightest > NEARLY_BLACK:
            return
    raise SourceError(
        f"{frames.path} is black: in {len(places)} frames from all over it nothing is brighter "
        f"than {brightest} of 255"
    )


LARGEST, REDUCED = 1920, 1280  # longer sides, pixels: of frames that are kept, and of smaller ones
FEWEST = 3  # motion is judged by accelerations


def choose_frames(draft: Draft, options: PrepareOptions) -> Draft:
    """Chooses frames of the video or folder: how many, how dense and from when to when.

    Raises:
        SourceError: fewer than three are left, or they have nothing in them.
    """
    path = draft.source.video
    choice = Choice(
        options.every, options.max_frames, options.fps, options.pick,
        Span.of(options.start, options.end), options.folder_fps,
    )  # fmt: skip
    frames = open_frames(path, options.width, choice)
    if len(frames) < FEWEST:
        raise SourceError(
            f"{path}: {len(frames)} of its frames would be used, as the options are; a "
            "clip shows motion, and needs three or more"
        )
    require_pictures(frames)
    notes = []
    if path.is_file() and choice.span.end is None and options.max_frames is None:
        notes += missing_frames(path, frames.total)
    if frames.variable:
        notes.append(
            "the video's frames are not evenly spaced (a variable frame rate): the clip keeps "
            f"their true times, {frames.fps:.4g} a second on average"
        )
    return draft.noting([*notes, *frames.notes], frames=frames.list)


def stored_width(found: FrameList) -> tuple[int | None, list[str]]:
    """The width of stored frames where none is given; smaller if they are larger than a clip needs.

    Returns:
        None for their own width; and what is to be said of it.
    """
    longest = max(found.native_width, found.native_height)
    if longest <= LARGEST:
        return None, []
    width = round(found.native_width * REDUCED / longest)
    return width, [
        f"frames of {found.native_width}x{found.native_height} are stored at a width of {width}"
        " (--width keeps more)"
    ]


def estimates(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Chooses whom to follow; finds their landmarks and masks."""
    used = {kind: e for kind, e in estimators.items() if kind in ("landmarks", "masks")}
    files = [path for e in used.values() for path in paths_of(e, draft.source.folder)]
    of_both = _reader(draft, options, estimators).of_both
    inputs = [
        fingerprint(files),
        {kind: identity(estimator) for kind, estimator in used.items()},
        draft.source.masked,
        of_both,
        _shown(draft, *options.people, *((options.object_name,) if of_both else ())),
        _object_shown(draft, options),
    ]
    draft.work.worth_keeping |= any(kind not in draft.source.beside for kind in used)

    def make() -> Draft:
        chosen = _choose_people(draft, options, estimators)
        try:
            reader = _reader(chosen, options, estimators)
            try:
                found = reader.landmarks_and_masks(progress)
            except PromptError as error:
                if not chosen.beside:
                    raise
                said = f"people beside the one who is fitted are not followed: {error}"
                chosen = chosen.noting([said], beside={})
                reader = _reader(chosen, options, estimators)
                found = reader.landmarks_and_masks(progress)
        except NobodyFoundError as error:
            if not _object_shown(draft, options):
                draft.work.worth_keeping = False
                raise
            said = f"{error}; so the clip has the object alone (--person X,Y@FRAME shows somebody)"
            draft.announce(said)
            chosen = chosen.noting(
                [said], unknown={"people": str(error)}, people=(), boxes={}, beside={}
            )
            reader = _reader(chosen, options, estimators)
            found = reader.landmarks_and_masks(progress)
        return chosen.noting(reader.notes_on_person(), estimates=found)

    return kept(draft, "estimates", options, make, inputs)


def _reader(draft: Draft, options: PrepareOptions, estimators: Estimators) -> EstimateReader:
    return EstimateReader(
        draft.source, draft.video, draft.people, tuple(draft.beside), draft.prompts, options,
        estimators, draft.work.root / "estimators",
    )  # fmt: skip


def _choose_people(draft: Draft, options: PrepareOptions, estimators: Estimators) -> Draft:
    """With one of several people, or all, where nobody was clicked on: announced at once."""
    draft = draft.noting(people=options.people)
    if not options.people or any(name in draft.clicks for name in options.people):
        return draft
    found = _reader(draft, options, estimators).seen()
    boxes, beside, said = chosen_people(options, found, draft.video.native_height)
    if not said:
        return draft
    draft.announce(said)
    return draft.noting([said], people=tuple(boxes), boxes=boxes, beside=beside)


def _shown(draft: Draft, *names: str) -> dict[str, Any]:
    """The prompts of some entities, as JSON."""
    prompts = draft.prompts
    return {name: prompts[name].model_dump(mode="json") for name in names if name in prompts}


def _object_shown(draft: Draft, options: PrepareOptions) -> bool:
    return options.find_object and options.object_name in draft.clicks


def object_masks(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Finds masks of objects by an estimator that has seen the person's, if there is one."""
    estimator, inputs = estimators.get("object"), None
    if estimator is not None:
        files = fingerprint(paths_of(estimator, draft.source.folder))
        names = (*draft.people, *draft.beside, *options.objects)
        inputs = [identity(estimator), files, _shown(draft, *names)]

    def make() -> Draft:
        if estimator is None and options.further_objects:
            raise SourceError(
                f"{len(options.objects)} objects are given, {' and '.join(options.objects)}; an "
                "estimator that follows them is needed: leave out the masks beside the video, and "
                "use --estimators offline"
            )
        if estimator is None:
            return draft
        found = _reader(draft, options, estimators).object_masks(progress)
        return draft.noting(found.notes, found_object=found)

    return kept(draft, "object_masks", options, make, inputs)


def cameras(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Chooses the cameras; from here on, frames without one are left out."""
    source, calibration = draft.source, options.calibration
    lens = None if calibration is None else calibration_file(calibration)[0]
    file = None if draft.body_file is None else draft.body_file.path
    known = [path for path in (source.colmap, source.cameras, lens, file) if path is not None]
    files = [[str(path), fingerprint([path])] for path in known]
    folder = draft.work.unfinished("cameras", key_of(draft, "cameras", options, files))

    def make() -> Draft:
        person, masks = draft.estimates.person, draft.estimates.masks
        beside = BesideVideo(source.colmap, source.cameras, draft.body_file)
        chosen = choose_cameras(draft.video, person, masks, beside, options, folder, progress)
        chosen = without_covered(chosen, person, masks)
        track = chosen.track.with_borders() if options.keep_borders else chosen.track
        return draft.noting(chosen.warnings, {"cameras": track.provenance}, track=track)

    found = kept(draft, "cameras", options, make, files)
    shutil.rmtree(folder, ignore_errors=True)
    model = found.track.model
    if model is not None and model.is_relative_to(draft.work.root):
        draft.work.worth_keeping = True  # structure from motion takes long
    if len(found.track.positions) < len(draft.video):
        return found.noting(video=draft.video.subset(found.track.positions))
    return found


def people(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Fits bodies on the undistorted images, which give the unit of a world that has none."""
    source, body = draft.source, draft.body
    inputs: list[Any] = [type(body).__qualname__, body.num_betas, len(body.parents)]
    inputs += [fingerprint([path]) for path in (source.ball,) if path is not None]
    if draft.body_file is not None:
        inputs.append(fingerprint([draft.body_file.path]))
    if not draft.people:  # the object's size is the unit
        inputs.append(draft.keys["object_masks"])

    def make() -> Draft:
        track, ball = draft.track, None
        undistorted = draft.estimates.undistorted(track.undistort, track.positions)
        if source.ball is not None and options.find_object:
            ball = refine_ball(load_ball(source.ball, draft.video, track.undistort), draft.images())
        found = draft.noting(undistorted=undistorted, ball=ball)
        if draft.people:
            bodies, unit = fit_people(found.observations(), track, body, options, progress)
            if draft.body_file is not None:
                name, first = next(iter(bodies.items()))
                text = f"{first.provenance}; {draft.body_file.used(draft.video.indices)}"
                bodies[name] = replace(first, provenance=text)
            texts = {
                f"body {name}" if k else "body": person.provenance
                for k, (name, person) in enumerate(bodies.items())
            }
            return found.noting(people_warnings(bodies), texts, bodies=bodies, unit=unit)
        masks = found.given_masks(options).object
        unit, text, warnings = unit_of_object(masks, track, options.object_size)
        unknown = {"unit of the world": text} if options.object_size is None else {}
        return found.noting(warnings, {"body": text}, unknown, unit=unit)

    return kept(draft, "people", options, make, inputs)


def masks(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Final masks, without common pixels."""

    def silhouettes() -> MaskStack:
        assert draft.person is not None  # masks of nobody are not separated
        pairs = zip(draft.person.posed(draft.body), draft.cameras, strict=True)
        return MaskStack(silhouette(v, draft.body.faces, c) for (v, _), c in pairs)

    def make() -> Draft:
        person = draft.person
        fitted = np.zeros(len(draft.track.positions), bool) if person is None else person.found
        sources = MaskSources(
            draft.given_masks(options), draft.ball, draft.images, silhouettes, fitted,
            draft.work.root,
        )  # fmt: skip
        found, text = final_masks(
            sources, draft.undistorted.further, draft.found_object, draft.track,
            keep_black=options.keep_black,
        )  # fmt: skip
        warnings = blank_warning(
            found.blank, draft.track.undistort.outside, draft.undistorted.masks.beside
        )
        return draft.noting(warnings, {"masks": text}, masks=found)

    return kept(draft, "masks", options, make)


def objects(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Tracks and shapes of all objects that the masks show."""
    return kept(draft, "objects", options, lambda: place_objects(draft, options, progress))


def place_objects(
    draft: Draft, options: PrepareOptions, progress: Callable[[float], None]
) -> Draft:
    """The draft with tracks and shapes of all objects that the masks show.

    An object goes with the hands of the person who is nearest to it.
    """
    masks, cameras, count = draft.masks, draft.cameras, len(options.objects)
    humans, person = masks.humans(), draft.undistorted.person
    joints = {owner: one.joints for owner, one in draft.bodies.items()}
    for k, name in enumerate(options.objects):
        first = k == 0
        stack = masks.object if first else masks.further.get(name)
        disc = draft.ball if first else None
        what = "the object" if count == 1 else f"the object {name}"
        if disc is None and (stack is None or not stack.coverage().any()):
            draft = _without(draft, name, what, options)
            continue
        assert stack is not None
        owner = nearest_person(joints, stack, cameras)
        filmed = Filmed(
            stack, humans, masks.other_objects(None if first else name), cameras, draft.images,
            draft.video.fps, None if owner is None else joints[owner], draft.body.parents,
            draft.unit.depths,
        )  # fmt: skip
        made = make_object(
            disc, filmed, way=options.object_track, radius=options.ball_radius,
            count=options.object_points, progress=partial(_share, progress, k, count),
        )  # fmt: skip
        provenance = {"object" if first else f"object {name}": made.track.provenance}
        if len(draft.bodies) > 1:
            provenance[f"hands at {name}"] = f"{owner}'s, who is nearest to it in most frames"
        windows = options.chunk is not None and options.chunk < len(cameras)
        rod = made.confidence.way == "rod"
        said = doubts(stack, None if person is None else person.image, humans, rod)
        said += _remarks(made, disc is not None, windows)
        unknown = {}
        if made.confidence.way != "texture and hands":
            unknown[f"rotation of {name}"] = made.confidence.reason
        draft = draft.noting(
            [text.replace("the object", what) for text in said], provenance, unknown,
            objects={**draft.objects, name: made},
        )  # fmt: skip
    return draft


def _share(progress: Callable[[float], None], number: int, count: int, done: float) -> None:
    """The progress of one of several equal works."""
    progress((number + done) / count)


def _without(draft: Draft, name: str, what: str, options: PrepareOptions) -> Draft:
    """Notes that an object is not in the clip."""
    if len(options.objects) > 1:
        said = (
            f"{what} was not found, so the clip has none of that name; point at it in another "
            f"frame: --object {name}=X,Y@FRAME"
        )
        return draft.noting([said], unknown={name: "it was not found"})
    provenance = {"object": "none: the clip shows the person alone"}
    if not options.find_object:
        return draft.noting(provenance=provenance)
    said = (
        "no object was found, so the clip has none; point at it with --object X,Y, or say that "
        "there is none with --object none"
    )
    return draft.noting([said], provenance, {name: "it was not found"})


def _remarks(made: MadeObject, disc: bool, windows: bool) -> list[str]:
    """Sentences on frames that do not show it, on poses that are not known well, and on memory."""
    said, confidence = [], made.confidence
    lost = (~made.track.observed).nonzero().flatten().tolist()
    if lost:
        said.append(f"no mask places the object in {len(lost)} frames: {ranges(lost)}")
    if confidence.way == "ball" and not disc:
        said.append(f"the object: {confidence.reason}; if it is none, --set object_track=texture")
    if confidence.way == "texture and hands" and windows:
        said.append(
            "the object is tracked by texture in all frames at once, whose small images are in "
            "memory together whatever --chunk is; --set object_track=outline needs none, and does "
            "not track its rotation"
        )
    if confidence.way == "outline":
        said.append(
            "the object's rotation is not tracked but for its roll, and its shape is a cushion "
            f"inflated from one outline: {confidence.reason}. Training has to find both"
        )
    return said


def scene(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Points of what stands still: those of a moving camera, or on planes and measured depth."""
    estimator, inputs = estimators.get("depth"), None
    if estimator is not None:
        inputs = [identity(estimator), fingerprint(paths_of(estimator, draft.source.folder))]

    def make() -> Draft:
        found, maps = _depth(draft, options, estimators, progress)
        track, unit, moving = found.track, found.unit, found.masks
        if not track.static:
            points = camera_scene(
                track.points * unit.metres, track.colors, moving, found.cameras, found.images,
                options.scene_points,
            )  # fmt: skip
            return found.noting(provenance={"scene": points.provenance}, scene=points)
        depth = found.depth

        def metres(frame: int) -> Float[np.ndarray, "H W"]:
            assert depth is not None and maps is not None
            return depth.metres(maps[frame], frame)

        points = static_scene(
            found.images, moving, found.cameras, ground=unit.ground,
            wall=options.backdrop * unit.distance, count=options.scene_points,
            metres=None if depth is None else metres,
        )  # fmt: skip
        if depth is None:
            said = (
                "the camera stays in one place: the scene's depth is supposed, only what moves has "
                "a measured place"
            )
            found = found.noting([said], unknown={"depth of the scene": "nothing measured it"})
        return found.noting(provenance={"scene": points.provenance}, scene=points)

    return kept(draft, "scene", options, make, inputs)


def _depth(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> tuple[Draft, DepthSource | None]:
    """With an estimator's depth against the cameras' points and the first person's surface, if
    there is an estimator and its maps can be used."""
    try:
        maps = depth_maps(draft, options, estimators)
    except HoigsError as error:
        if "depth" not in draft.source.beside:
            raise
        said = (
            "depth/ beside the video is not used (name it with --set "
            f"estimators.depth.use=estimator:depth-files and its settings, to use it): {error}"
        )
        return draft.noting([said], unknown={"depth of the scene": str(error)}), None
    if maps is None:
        return draft, None
    person, scene_masks, views = draft.person, draft.masks, draft.cameras
    surfaces = [] if person is None else [vertices for vertices, _ in person.posed(draft.body)]
    points = draft.track.points * draft.unit.metres
    fit = fit_depth(
        maps,
        lambda i: seen_points(points, views[i], scene_masks.moving(i)),
        lambda i: seen_surface(
            surfaces[i] if surfaces else torch.zeros(0, 3), views[i], scene_masks.human[i]
        ),
        len(views),
        progress,
    )
    said = f"depth is {100 * fit.typical:.0f} % off {fit.against}: see the report"
    warnings = [said] if fit.typical > POOR else []
    return draft.noting(warnings, {"depth": fit.provenance}, depth=fit), maps


def depth_maps(draft: Draft, options: PrepareOptions, estimators: Estimators) -> DepthSource | None:
    """An estimator's depth of the frames, in its own unit; None without one."""
    if "depth" not in estimators:
        return None
    maps = _reader(draft, options, estimators).estimate("depth", lambda _done: None).depth
    assert maps is not None  # `checked` saw to it
    return DepthSource(maps, draft.video, draft.track.undistort)


def write(
    draft: Draft, options: PrepareOptions, estimators: Estimators, progress: Advance
) -> Draft:
    """Writes the clip folder, with the report in it."""
    maps = None if draft.depth is None else depth_maps(draft, options, estimators)
    return write_clip_folder(draft, options, maps, progress)


STAGES = {
    "frames": frames, "estimates": estimates, "object_masks": object_masks, "cameras": cameras,
    "people": people, "masks": masks, "objects": objects, "scene": scene, "write": write,
}  # fmt: skip
