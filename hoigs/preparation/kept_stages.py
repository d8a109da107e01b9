"""KeptStages: the results of stages, kept in the work folder with what the stages noted."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

import hoigs
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.lens import Lens
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.body.landmarks import FrameFates, LandmarkTrack
from hoigs.preparation.cameras.camera_track import CameraTrack
from hoigs.preparation.cameras.choose import ChosenCameras
from hoigs.preparation.entities.final_masks import EntityMasks
from hoigs.preparation.entities.people import FittedBody, FittedPeople, Nobody
from hoigs.preparation.estimates.given import GivenMasks, RawLandmarks
from hoigs.preparation.estimates.reader import (
    FoundObject,
    RawEstimates,
    RawPerson,
    UndistortedEstimates,
    UndistortedPerson,
)
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.objects.make_object import MadeObject
from hoigs.preparation.objects.tracked import ObjectConfidence
from hoigs.preparation.scene.depth import DepthFit
from hoigs.preparation.scene.scene_points import ScenePoints
from hoigs.preparation.stages import PLAN, Stages
from hoigs.preparation.video.frames import FrameList
from hoigs.preparation.work_folder import Result, WorkFolder, digest

# Results of the stages as JSON and arrays, and back, to the last bit.
#
# A result may hold tensors, arrays, masks, cameras, paths, containers and dataclasses of `CLASSES`.
# Each becomes JSON that names its kind, and arrays.

CLASSES = {
    found.__name__: found
    for found in (
        BallTrack, BodyPose, CameraTrack, ChosenCameras, DepthFit, EntityMasks, FittedBody,
        FittedPeople, FoundObject, FrameFates, FrameList, GivenMasks, LandmarkTrack, Lens,
        MadeObject, Nobody, ObjectConfidence, ObjectTrack, RawEstimates, RawLandmarks, RawPerson,
        ScenePoints, UndistortedEstimates, UndistortedPerson,
    )
}  # fmt: skip


def to_result(value: Any) -> Result:
    """A stage's result as the work folder keeps it."""
    arrays: dict[str, np.ndarray] = {}
    return Result({"result": _pack(value, "result", arrays)}, arrays)


def from_result(result: Result) -> Any:
    """What `to_result` was given."""
    return _unpack(result.values["result"], result.arrays)


def _pack(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """JSON of a value; its arrays are put into `arrays` under names that begin with `name`."""
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
        return {"path": str(value)}
    if isinstance(value, list) and value and isinstance(value[0], Camera):
        arrays[f"{name}.K"] = torch.stack([c.K for c in value]).numpy()
        arrays[f"{name}.view"] = torch.stack([c.world_to_camera for c in value]).numpy()
        return {"cameras": name, "size": [value[0].width, value[0].height]}
    if isinstance(value, list | tuple):
        items = [_pack(item, f"{name}.{i}", arrays) for i, item in enumerate(value)]
        return {"list" if isinstance(value, list) else "tuple": items}
    if isinstance(value, dict):
        return {"dict": {key: _pack(item, f"{name}.{key}", arrays) for key, item in value.items()}}
    if is_dataclass(value):
        names = [field.name for field in fields(value)]
        packed = {key: _pack(getattr(value, key), f"{name}.{key}", arrays) for key in names}
        return {"class": type(value).__name__, "fields": packed}
    return value  # of JSON's own


def _unpack(packed: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    match packed:
        case {"tensor": name}:
            return torch.from_numpy(arrays[name])
        case {"array": name}:
            return arrays[name]
        case {"masks": name, "size": [height, width]}:
            return MaskStack.from_deflated(arrays[name], arrays[f"{name}.lengths"], (height, width))
        case {"path": path}:
            return Path(path)
        case {"cameras": name, "size": size}:
            K, views = (torch.from_numpy(arrays[f"{name}.{part}"]) for part in ("K", "view"))
            return [Camera(K[i], views[i], *size) for i in range(len(K))]
        case {"list": items}:
            return [_unpack(item, arrays) for item in items]
        case {"tuple": items}:
            return tuple(_unpack(item, arrays) for item in items)
        case {"dict": items}:
            return {key: _unpack(item, arrays) for key, item in items.items()}
        case {"class": name, "fields": items}:
            return CLASSES[name](**{key: _unpack(item, arrays) for key, item in items.items()})
    return packed


def save_cameras(chosen: ChosenCameras) -> Result:
    """With a copy of the COLMAP model that the stage made itself, in a temporary folder."""
    made, model = to_result(chosen), chosen.track.model
    if not chosen.own_model or model is None:
        return made
    return Result(made.values, made.arrays, lambda to: shutil.copytree(model, to / "colmap"))


def load_cameras(result: Result) -> ChosenCameras:
    """With the path of that copy."""
    chosen: ChosenCameras = from_result(result)
    if not chosen.own_model:
        return chosen
    assert result.folder is not None
    return replace(chosen, track=replace(chosen.track, model=result.folder / "colmap"))


FORMAT = 12  # of what the stages keep; another number makes older results unread
T = TypeVar("T")


class KeptStages:
    """Runs stages, or reads back what they gave before.

    Attributes:
        warnings, provenance: of all stages so far; a stage that is read back adds what it noted
            when it was made.
        worth_keeping: whether one that took long was made.
    """

    def __init__(self, stages: Stages, work: WorkFolder) -> None:
        self.stages, self.work = stages, work
        self.warnings: list[str] = []
        self.provenance: dict[str, str] = {}
        self.worth_keeping = False
        self._keys: dict[str, str] = {}

    def run(
        self,
        name: str,
        options: Mapping[str, Any],
        make: Callable[[], T],
        made_from: Any = None,
        save: Callable[[T], Result] = to_result,
        load: Callable[[Result], T] = from_result,
        remarks: Callable[[], Sequence[str]] = tuple,
    ) -> T:
        """A stage's result from the work folder; it is made first where it is not there.

        It is read back even when it has just been made, so that a resumed run gives the same as an
        unbroken one.

        Args:
            options: all of the preparation's, as JSON.
            made_from: JSON of whatever else the result depends on, beside PLAN's options.
            remarks: warnings of the video's reader, once the stage is made.
        """
        key = self._keys[name] = self.key(name, options, made_from)
        with self.stages.stage(name):
            stored = self.work.load(name, key)
            if stored is None:
                warned, known = len(self.warnings), dict(self.provenance)
                made = save(make())
                self.warnings += [text for text in remarks() if text not in self.warnings]
                notes: dict[str, Any] = {
                    "warnings": self.warnings[warned:],
                    "provenance": {k: v for k, v in self.provenance.items() if k not in known},
                    "seconds": self.stages.elapsed(),
                }
                values = {"made": made.values, "notes": notes}
                stored = self.work.save(
                    name, key, Result(values, made.arrays, made.files, made.folder)
                )
                self.worth_keeping |= PLAN[name].slow
            else:
                notes = stored.values["notes"]
                self.warnings += notes["warnings"]
                self.provenance |= notes["provenance"]
            value = load(Result(stored.values["made"], stored.arrays, None, stored.folder))
        self.stages.seconds[name] = notes["seconds"]
        return value

    def key(self, name: str, options: Mapping[str, Any], made_from: Any = None) -> str:
        """What a stage's result is stored under: a digest of all that it is made from."""
        stage = PLAN[name]
        return digest(
            {
                "format": [FORMAT, hoigs.__version__],
                "options": {key: options[key] for key in stage.options},
                "reads": {other: self._keys[other] for other in stage.reads},
                "from": made_from,
            }
        )

    def key_of(self, name: str) -> str:
        """The key of a stage that has run."""
        return self._keys[name]
