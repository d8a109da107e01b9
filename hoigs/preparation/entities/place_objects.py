"""Every object of a clip: its track, where it comes from, and what is doubtful about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from hoigs.core.reporting import ranges
from hoigs.core.values.camera import Camera
from hoigs.preparation.entities.final_masks import EntityMasks
from hoigs.preparation.entities.people import FittedPeople
from hoigs.preparation.estimates.reader import UndistortedEstimates
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.objects.hands import nearest_person
from hoigs.preparation.objects.make_object import MadeObject, doubts, make_object
from hoigs.preparation.options import PrepareOptions


@dataclass(frozen=True)
class PlacedObjects:
    """The objects that are seen at all, by name, and sentences for the report.

    Attributes:
        provenance: "object" of the first one, "object NAME" of others.
    """

    objects: dict[str, MadeObject] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def place_objects(
    masks: EntityMasks,
    estimates: UndistortedEstimates,
    people: FittedPeople,
    cameras: Sequence[Camera],
    parents: Sequence[int],
    images: Images,
    options: PrepareOptions,
    fps: float,
    progress: Callable[[float], None],
) -> PlacedObjects:
    """Tracks and shapes of all objects that the masks show.

    Args:
        estimates: with the first object's disc, if it was tracked as a ball, and the first
            person's landmarks. people: the fitted bodies; an object goes with the hands of the one
            who is nearest to it. parents: of their joints.
        images: gives the undistorted frames anew on every call.
    """
    placed, count = PlacedObjects(), len(options.objects)
    humans, ball = masks.humans(), estimates.ball
    for k, name in enumerate(options.objects):
        first = k == 0
        stack = masks.object if first else masks.further.get(name)
        disc = ball if first else None
        what = "the object" if count == 1 else f"the object {name}"
        if disc is None and (stack is None or not stack.coverage().any()):
            _without(name, what, options, placed)
            continue
        assert stack is not None
        joints = {owner: person.joints for owner, person in people.people.items()}
        owner = nearest_person(joints, stack, cameras)
        made = make_object(
            disc, stack, humans, masks.other_objects(None if first else name), cameras,
            None if owner is None else people.people[owner].joints, parents, images,
            way=options.object_track, radius=options.ball_radius, count=options.object_points,
            fps=fps, progress=partial(_share, progress, k, count),
            depths=None if people.nobody is None else people.nobody.depths,
        )  # fmt: skip
        placed.objects[name] = made
        placed.provenance["object" if first else f"object {name}"] = made.track.provenance
        if len(people.people) > 1:
            placed.provenance[f"hands at {name}"] = (
                f"{owner}'s, who is nearest to it in most frames"
            )
        marks = None if estimates.landmarks is None else estimates.landmarks.image
        windows = options.chunk is not None and options.chunk < len(cameras)
        said = [*doubts(stack, marks), *_remarks(made, disc is not None, windows)]
        placed.warnings.extend(text.replace("the object", what) for text in said)
    return placed


def _share(progress: Callable[[float], None], number: int, count: int, done: float) -> None:
    """The progress of one of several equal works."""
    progress((number + done) / count)


def _without(name: str, what: str, options: PrepareOptions, placed: PlacedObjects) -> None:
    """Says that an object is not in the clip."""
    if len(options.objects) > 1:
        placed.warnings.append(
            f"{what} was not found, so the clip has none of that name; point at it in another "
            f"frame: --object {name}=X,Y@FRAME"
        )
        return
    placed.provenance["object"] = "none: the clip shows the person alone"
    if options.find_object:
        placed.warnings.append(
            "no object was found, so the clip has none; point at it with --object X,Y, or "
            "say that there is none with --object none"
        )


def _remarks(made: MadeObject, disc: bool, windows: bool) -> list[str]:
    """Sentences on frames that do not show it, on poses that are not known well, and on memory."""
    said, confidence = [], made.confidence
    lost = (~made.track.observed).nonzero().flatten().tolist()
    if lost:
        said.append(f"the object is not seen in {len(lost)} frames: {ranges(lost)}")
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
