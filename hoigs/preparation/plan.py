"""The stages of a preparation: their order, what each builds on, and which options it reads."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from hoigs.core.errors import HoigsError, did_you_mean


@dataclass(frozen=True)
class Stage:
    """One stage.

    Attributes:
        weight: its share of the time, roughly. after: the stages whose results it reads.
        options: of PrepareOptions, that change its result.
        long: its result is worth keeping when a later stage refuses the source.
    """

    weight: float
    after: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    long: bool = False


PLAN = {
    "frames": Stage(2, (), ("width", "every", "fps", "max_frames", "pick", "folder_fps")),
    "evidence": Stage(4, ("frames",), ("human", "object", "prompts")),
    "cameras": Stage(3, ("frames", "evidence"), ("camera", "focal")),
    "inputs": Stage(6, ("evidence", "cameras")),
    "body": Stage(40, ("inputs",), ("body", "fit_steps"), long=True),
    "masks": Stage(10, ("inputs", "body"), ("keep_black",), long=True),
    "object": Stage(4, ("masks",), ("ball_radius", "object_points"), long=True),
    "depth": Stage(4, ("masks",), ("prompts",), long=True),
    "scene": Stage(6, ("masks", "depth"), ("scene_points", "backdrop"), long=True),
    "writing": Stage(40, ("object", "scene")),
}


def check_stage(name: str) -> None:
    """HoigsError if there is no such stage."""
    if name not in PLAN:
        raise HoigsError(
            f"there is no stage {name!r}{did_you_mean(name, PLAN)}; in order: {', '.join(PLAN)}"
        )


def and_after(names: Iterable[str]) -> set[str]:
    """The named stages and all that build on them."""
    found = set(names)
    for name, stage in PLAN.items():  # in order, so that one pass suffices
        if found & set(stage.after):
            found.add(name)
    return found
