"""What each stage is made from, and its result in the work folder, to the last bit.

A result holds tensors, arrays, masks, cameras, paths, containers and the dataclasses that a draft
has. Each becomes JSON that names its kind, and arrays.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import torch
from torch import Tensor

import hoigs
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.values.camera import Camera
from hoigs.preparation.draft import Draft
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.work_folder import Result, WorkFolder, digest

FORMAT = 14  # of what is kept; another number makes older results unread


@dataclass(frozen=True)
class Stage:
    """What a stage is made from.

    Attributes:
        weight: its share of the time, about. reads: the stages whose results it reads.
        options: fields of PrepareOptions that change its result.
        slow: its result is kept even if a later stage finds that the source cannot be used.
        version: of its code; another one makes older results unread.
    """

    weight: float
    reads: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    slow: bool = False
    version: int = 1


PLAN = {
    "frames": Stage(
        2,
        (),
        ("width", "every", "fps", "max_frames", "pick", "folder_fps", "start", "end"),
        version=2,
    ),
    "estimates": Stage(
        30,
        ("frames",),
        ("human_name", "further_people", "find_person", "everybody", "object_name"),
        slow=True,
        version=6,
    ),
    "object_masks": Stage(
        30, ("estimates",), ("object_name", "further_objects"), slow=True, version=17
    ),
    "cameras": Stage(
        3,
        ("frames", "estimates"),
        ("camera", "focal", "intrinsics", "calibration", "keep_borders"),
        version=8,
    ),
    "people": Stage(
        46,
        ("estimates", "cameras"),
        ("find_object", "body", "fit_steps", "person_height", "object_size", "chunk", "overlap"),
        slow=True,
        version=10,
    ),
    "masks": Stage(10, ("people", "object_masks"), ("keep_black",), slow=True, version=3),
    "objects": Stage(
        40, ("masks",), ("ball_radius", "object_points", "object_track"), slow=True, version=8
    ),
    "scene": Stage(10, ("masks",), ("prompts", "scene_points", "backdrop"), slow=True, version=2),
    "write": Stage(40, ("objects", "scene")),
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


def key_of(draft: Draft, name: str, options: PrepareOptions, inputs: Any = None) -> str:
    """What a stage's result is stored under: a digest of all that it is made from.

    Args:
        inputs: JSON of whatever else the result depends on, beside what PLAN says.
    """
    stage, values = PLAN[name], options.model_dump(mode="json")
    return digest(
        {
            "format": [FORMAT, hoigs.__version__, stage.version],
            "options": {key: values[key] for key in stage.options},
            "reads": {other: draft.keys[other] for other in stage.reads},
            "from": inputs,
        }
    )


def kept(
    draft: Draft,
    name: str,
    options: PrepareOptions,
    make: Callable[[], Draft],
    inputs: Any = None,
) -> Draft:
    """What a stage makes of the draft, from the work folder; it is made first if it is not there.

    It is read back even when it has just been made, so that a resumed run gives the same as an
    unbroken one. What is kept are the fields that `make` filled in, and what it noted.

    Args:
        inputs: JSON of whatever else the result depends on, beside what PLAN says.
    """
    key = key_of(draft, name, options, inputs)
    stored = draft.work.load(name, key)
    if stored is None:
        start, grown = time.perf_counter(), make()
        if grown.video is not None:
            notes = [text for text in grown.video.notes if text not in grown.warnings]
            grown = grown.noting(notes)
        stored = draft.work.save(name, key, _changes(draft, grown, start))
        draft.work.worth_keeping |= PLAN[name].slow
    values = stored.values
    return draft.noting(
        values["warnings"], values["provenance"], values["unknown"],
        keys={**draft.keys, name: key}, seconds={**draft.seconds, name: values["seconds"]},
        **_unpacked(stored),
    )  # fmt: skip


NOTES = ("warnings", "provenance", "unknown")


def _changes(draft: Draft, grown: Draft, start: float) -> Result:
    """What one draft has and the one before has not."""
    arrays: dict[str, np.ndarray] = {}
    paths: dict[str, Path] = {}
    packed = {}
    for name in (field.name for field in fields(Draft) if field.name not in NOTES):
        value = getattr(grown, name)
        if value is not getattr(draft, name):
            packed[name] = _pack(value, name, arrays, paths)
    inside = {n: path for n, path in paths.items() if path.is_relative_to(draft.work.root)}

    def copy(to: Path) -> None:
        for name, path in inside.items():
            shutil.copytree(path, to / name)

    values = {
        "format": FORMAT,
        "fields": packed,
        "inside": sorted(inside),
        "warnings": list(grown.warnings[len(draft.warnings) :]),
        "provenance": _added(draft.provenance, grown.provenance),
        "unknown": _added(draft.unknown, grown.unknown),
        "seconds": round(time.perf_counter() - start, 2),
    }
    return Result(values, arrays, copy)


def _added(before: Mapping[str, str], after: Mapping[str, str]) -> dict[str, str]:
    return {name: text for name, text in after.items() if before.get(name) != text}


def last_kept(root: Path, stage: str) -> dict[str, Any]:
    """The fields of a draft that a stage filled in last, whatever it was made from; none if it
    has not run, or was run by another version."""
    stored = WorkFolder(root).load(stage)
    if stored is None or stored.values.get("format") != FORMAT:
        return {}
    return _unpacked(stored)


def _pack(value: Any, name: str, arrays: dict[str, np.ndarray], paths: dict[str, Path]) -> Any:
    """JSON of a value; its arrays are put into `arrays`, and its paths into `paths`, under names
    that begin with `name`."""
    if isinstance(value, Tensor):
        arrays[name] = value.detach().cpu().numpy()
        return {"tensor": name}
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {"array": name}
    if isinstance(value, MaskStack):
        arrays[name], arrays[f"{name}.lengths"] = value.deflated()
        return {"masks": name, "size": list(value.shape)}
    if isinstance(value, Path):
        paths[name] = value
        return {"path": str(value), "name": name}
    if isinstance(value, list) and value and isinstance(value[0], Camera):
        arrays[f"{name}.K"] = torch.stack([c.K for c in value]).numpy()
        arrays[f"{name}.view"] = torch.stack([c.world_to_camera for c in value]).numpy()
        return {"cameras": name, "size": [value[0].width, value[0].height]}
    if isinstance(value, list | tuple):
        items = [_pack(item, f"{name}.{i}", arrays, paths) for i, item in enumerate(value)]
        return {"list" if isinstance(value, list) else "tuple": items}
    if isinstance(value, dict):
        each = {key: _pack(item, f"{name}.{key}", arrays, paths) for key, item in value.items()}
        return {"dict": each}
    if is_dataclass(value):
        parts = [field.name for field in fields(value)]
        return {
            "class": type(value).__name__,
            "fields": {p: _pack(getattr(value, p), f"{name}.{p}", arrays, paths) for p in parts},
        }
    return value  # of JSON's own


def _unpacked(stored: Result) -> dict[str, Any]:
    arrays, folder, inside = stored.arrays, stored.folder, stored.values["inside"]

    def unpack(packed: Any) -> Any:
        match packed:
            case {"tensor": name}:
                return torch.from_numpy(arrays[name])
            case {"array": name}:
                return arrays[name]
            case {"masks": name, "size": [height, width]}:
                lengths = arrays[f"{name}.lengths"]
                return MaskStack.from_deflated(arrays[name], lengths, (height, width))
            case {"path": path, "name": name}:
                return folder / name if folder is not None and name in inside else Path(path)
            case {"cameras": name, "size": size}:
                K, views = (torch.from_numpy(arrays[f"{name}.{part}"]) for part in ("K", "view"))
                return [Camera(K[i], views[i], *size) for i in range(len(K))]
            case {"list": items}:
                return [unpack(item) for item in items]
            case {"tuple": items}:
                return tuple(unpack(item) for item in items)
            case {"dict": items}:
                return {key: unpack(item) for key, item in items.items()}
            case {"class": name, "fields": items}:
                return _classes()[name](**{key: unpack(item) for key, item in items.items()})
        return packed

    return {name: unpack(value) for name, value in stored.values["fields"].items()}


@cache
def _classes() -> dict[str, type]:
    """The dataclasses that a draft's fields may hold, by name: a file can name no others."""
    found: dict[str, type] = {}
    waiting = list(get_type_hints(Draft).values())
    while waiting:
        kind = waiting.pop()
        waiting += get_args(kind)
        if isinstance(kind, type) and is_dataclass(kind) and kind.__name__ not in found:
            found[kind.__name__] = kind
            waiting += get_type_hints(kind).values()
    return found
