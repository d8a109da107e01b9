"""Every object of a clip: its track, where it comes from, and what is doubtful about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from jaxtyping import Float
from torch import Tensor

from hoigs.core.diagnostics import ranges
from hoigs.core.values.camera import Camera
from hoigs.preparation.entity_masks import EntityMasks
from hoigs.preparation.masks.separate import Images
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.objects.doubts import doubts
from hoigs.preparation.objects.make_object import MadeObject, make_object
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
    ball: BallTrack | None,
    landmarks: Float[Tensor, "F 33 3"],
    cameras: Sequence[Camera],
    joints: Float[Tensor, "F J 3"],
    parents: Sequence[int],
    images: Images,
    options: PrepareOptions,
    fps: float,
    progress: Callable[[float], None],
) -> PlacedObjects:
    """Tracks and shapes of all objects that the masks show.

    Args:
        ball: of the first object, if its disc was tracked. landmarks: x, y in pixels and
            visibility. joints: of the fitted body, metres, and `parents` of each.
        images: gives the undistorted frames anew on every call.
    """
    placed, count = PlacedObjects(), len(options.objects)
    for k, name in enumerate(options.objects):
        first = k == 0
        stack = masks.object if first else masks.further.get(name)
        disc = ball if first else None
        what = "the object" if count == 1 else f"the object {name}"
        if disc is None and (stack is None or not stack.coverage().any()):
            _without(name, what, options, placed)
            continue
        assert stack is not None
        made = make_object(
            disc, stack, masks.human, masks.other_objects(None if first else name), cameras,
            joints, parents, images, way=options.object_track, radius=options.ball_radius,
            count=options.object_points, fps=fps, progress=partial(_share, progress, k, count),
        )  # fmt: skip
        placed.objects[name] = made
        placed.provenance["object" if first else f"object {name}"] = made.track.provenance
        said = [*doubts(stack, landmarks), *_remarks(made, disc is not None)]
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


def _remarks(made: MadeObject, disc: bool) -> list[str]:
    """Sentences on frames that do not show it, and on poses that are not known well."""
    said, confidence = [], made.confidence
    lost = (~made.track.observed).nonzero().flatten().tolist()
    if lost:
        said.append(f"the object is not seen in {len(lost)} frames: {ranges(lost)}")
    if confidence.way == "ball" and not disc:
        said.append(f"the object: {confidence.reason}; if it is none, --set object_track=texture")
    if confidence.way == "outline":
        said.append(
            "the object's rotation is not tracked but for its roll, and its shape is a cushion "
            f"inflated from one outline: {confidence.reason}. Training has to find both"
        )
    return said
