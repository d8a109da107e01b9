"""The stages of a preparation: order, times, progress, and what a killed run left."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.reporting import Progress, no_progress


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


# Named stages of a long job: their times, and one progress number for all.

T = TypeVar("T")


class Stages:
    """Times the stages and reports the progress of the whole.

    Args:
        weights: stage name to its share of the time, roughly; in order.
        progress: called with 0..1 and the stage's name; None: not called.
    """

    def __init__(self, weights: Mapping[str, float], progress: Progress | None = None) -> None:
        total = sum(weights.values())
        self._share = {name: weight / total for name, weight in weights.items()}
        self._progress = progress or no_progress
        self._before = 0.0
        self._name = ""
        self._start = 0.0
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """One of the named stages."""
        self._name = name
        self._progress(self._before, name)
        self._start = time.perf_counter()
        yield
        self.seconds[name] = self.elapsed()
        self._before += self._share[name]
        self._progress(self._before, name)

    def elapsed(self) -> float:
        """Seconds since the current stage began."""
        return round(time.perf_counter() - self._start, 2)

    def advance(self, fraction: float) -> None:
        """`fraction` 0..1 of the current stage is done."""
        self._progress(self._before + fraction * self._share[self._name], self._name)

    def track(self, items: Iterable[T], count: int) -> Iterator[T]:
        """`items`, advancing by one of `count` with each."""
        for done, item in enumerate(items, start=1):
            yield item
            self.advance(done / count)


# Temporary folders beside a clip that a killed process left: the next run removes them.

RECORD = "writing.json"


class Cleanup:
    """Removes what the writing of one clip leaves beside it if the process is killed.

    Only folders are removed that a run registered before it filled them, or whose names and
    contents are those of a half-replaced clip.

    Args:
        clip: the folder to be made. work: the work folder, which one process at a time uses.
    """

    def __init__(self, clip: Path, work: Path) -> None:
        self.clip, self._record = clip, work / RECORD

    def register(self, temporary: Path) -> None:
        """To be called before anything large is in this temporary folder."""
        part = self._record.with_name("." + RECORD)
        part.write_text(json.dumps({"temporary": temporary.name}), encoding="utf-8")
        part.replace(self._record)

    def remove(self) -> None:
        """Removes the registered folder, if it is there, and clips that a new one has replaced."""
        beside = self.clip.parent
        if self._record.is_file():
            name = json.loads(self._record.read_text(encoding="utf-8"))["temporary"]
            folder = beside / name
            if name.startswith(f".{self.clip.name}.") and folder.is_dir():
                shutil.rmtree(folder)
            self._record.unlink()
        if self.clip.is_dir():
            for folder in beside.glob(f".{self.clip.name}.old.*"):
                if [p.name for p in folder.iterdir()] in ([], ["clip"]):
                    shutil.rmtree(folder)
