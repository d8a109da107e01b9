"""The stages of a preparation: their order, and the results and options that each reads."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from hoigs.core.errors import HoigsError, did_you_mean


@dataclass(frozen=True)
class Stage:
    """One stage.

    Attributes:
        weight: its share of the time, about. reads: the stages whose results it reads.
        options: fields of PrepareOptions that change its result.
        slow: its result is kept even if a later stage finds that the source cannot be used.
    """

    weight: float
    reads: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    slow: bool = False


PLAN = {
    "frames": Stage(
        2, (), ("width", "every", "fps", "max_frames", "pick", "folder_fps", "start", "end")
    ),
    "evidence": Stage(
        30, ("frames",), ("human", "further_people", "find_person", "object"), slow=True
    ),
    "object_masks": Stage(30, ("evidence",), ("object", "further_objects"), slow=True),
    "cameras": Stage(3, ("frames", "evidence"), ("camera", "focal", "intrinsics", "calibration")),
    "inputs": Stage(6, ("evidence", "cameras"), ("find_object",)),
    "body": Stage(
        40,
        ("inputs",),
        ("body", "fit_steps", "person_height", "object_size", "chunk", "overlap"),
        slow=True,
    ),
    "masks": Stage(10, ("inputs", "body", "object_masks"), ("keep_black",), slow=True),
    "object": Stage(40, ("masks",), ("ball_radius", "object_points", "object_track"), slow=True),
    "depth": Stage(4, ("masks",), ("prompts",), slow=True),
    "scene": Stage(6, ("masks", "depth"), ("scene_points", "backdrop"), slow=True),
    "writing": Stage(40, ("object", "scene")),
}


def check_stage(name: str) -> None:
    """HoigsError if there is no such stage."""
    if name not in PLAN:
        raise HoigsError(
            f"there is no stage {name!r}{did_you_mean(name, PLAN)}; in order: {', '.join(PLAN)}"
        )


def with_dependents(names: Iterable[str]) -> set[str]:
    """The named stages and all that read their results, directly or not."""
    found = set(names)
    for name, stage in PLAN.items():  # in order, so that one pass suffices
        if found & set(stage.reads):
            found.add(name)
    return found
