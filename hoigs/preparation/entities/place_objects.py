"""Every object of a clip: its track, where it comes from, and what is doubtful about it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from hoigs.core.reporting import ranges
from hoigs.preparation.draft import Draft
from hoigs.preparation.objects.hands import nearest_person
from hoigs.preparation.objects.make_object import MadeObject, doubts, make_object
from hoigs.preparation.options import PrepareOptions


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
        made = make_object(
            disc, stack, humans, masks.other_objects(None if first else name), cameras,
            None if owner is None else joints[owner], draft.body.parents, draft.images,
            way=options.object_track, radius=options.ball_radius, count=options.object_points,
            fps=draft.video.fps, progress=partial(_share, progress, k, count),
            depths=draft.unit.depths,
        )  # fmt: skip
        provenance = {"object" if first else f"object {name}": made.track.provenance}
        if len(draft.bodies) > 1:
            provenance[f"hands at {name}"] = f"{owner}'s, who is nearest to it in most frames"
        windows = options.chunk is not None and options.chunk < len(cameras)
        said = doubts(stack, None if person is None else person.image)
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
