"""Exporter: a trained scene, its clip and some moments to files of another program's format."""

from __future__ import annotations

import json
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import torch

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.model.entity import name_of
from hoigs.core.model.scene import SceneModel
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import EntityKind

SHEET = "export.json"  # what an export has kept and lost, beside its files


@dataclass(frozen=True)
class ExportRequest:
    """What is exported.

    Attributes:
        scene: the trained model. An exporter changes neither its parameters nor its mode.
        clip: what the model was trained on: cameras, points, bodies, frame rate.
        moments: at which the scene is exported, times ascending. A format without motion may take
            the first one, and then reports the others in `Exported.omitted`.
        entities: names of the entities to export, in the scene's order; empty for all.
        bodies: the body model of each human, by entity, where there is one.
        fps: moments a second in the files, where the format has a clock; 0 for the clip's.

    Raises:
        ValueError: no moments, times that do not ascend, or an entity that the scene lacks.
    """

    scene: SceneModel
    clip: Clip
    moments: tuple[Moment, ...]
    entities: tuple[str, ...] = ()
    bodies: Mapping[str, BodyModel] = field(default_factory=dict)
    fps: float = 0.0

    def __post_init__(self) -> None:
        times = [moment.time for moment in self.moments]
        if not times or any(b <= a for a, b in pairwise(times)):
            raise ValueError(f"times to export are {times}, expected one or more that ascend")
        known = self.scene.names()
        for name in self.entities:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(
                    f'the scene has no entity "{name}"{hint} (it has {", ".join(known)})'
                )
        chosen = tuple(n for n in known if not self.entities or n in self.entities)
        object.__setattr__(self, "entities", chosen)
        if not self.fps > 0:
            object.__setattr__(self, "fps", self.clip.fps)

    def of_kind(self, kind: EntityKind) -> list[str]:
        """The entities to export that are of a kind."""
        return [name for name in self.entities if self.scene.entity(name).kind == kind]


FEW = 4  # files that are listed one by one


@dataclass(frozen=True)
class Exported:
    """What an export has written.

    Attributes:
        folder: the new folder.
        files: path of each file below `folder`, with "/", to its size in bytes.
        omitted: what of the scene the format cannot hold, to the reason.
        supposed: what the files say that nobody knows, to where it was taken from.
    """

    folder: Path
    files: Mapping[str, int]
    omitted: Mapping[str, str] = field(default_factory=dict)
    supposed: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        sizes = list(self.files.items())
        lines = [f"{self.folder / name}: {size} bytes" for name, size in sizes[:FEW]]
        if len(sizes) > FEW:
            (first, _), (last, _) = sizes[0], sizes[-1]
            total = sum(self.files.values())
            lines = [f"{self.folder}: {len(sizes)} files, {total} bytes: {first} … {last}"]
        lines += [f"not exported: {k}: {v}" for k, v in self.omitted.items()]
        return "\n".join([*lines, *(f"supposed: {k}: {v}" for k, v in self.supposed.items())])


def require_own_colors(scene: SceneModel, who: str) -> None:
    """Raise HoigsError where a decoder makes the pictures of the scene, which `who` writes without
    one."""
    if scene.decoder is not None:
        raise HoigsError(
            f"{who} writes Gaussians or surfaces with colours, and a decoder, "
            f"{name_of(scene.decoder)}, makes the pictures of this scene: in another program they "
            "would look otherwise. `hoigs render` and `hoigs view` use the decoder; formats of a "
            "skeleton alone, such as bvh, can be exported"
        )


class Exporter(Configurable, ABC):
    """One file format.

    A subclass writes `write`. Callers use `export`, which makes the folder appear complete or not
    at all, with a sheet `export.json` that lists what was kept and lost, units and axes.

    Attributes:
        suffixes: what the name of the file may end with, if an export is one file, the usual one
            first; empty where it is a folder of files.
        kinds: kinds of entities that the format can hold; others are left out.
        moving: whether the files hold more than one moment.
        reads_gaussians: False if nothing of the Gaussians enters the files, as with a skeleton.
        up: the axis of the files that points against gravity, "y" or "z"; "clip" where they keep
            the world of the clip.
        axes: of the coordinates in the files. units: of lengths.
        keeps: what the files hold, to the form it has there.
    """

    suffixes: tuple[str, ...] = ()
    kinds: ClassVar[frozenset[EntityKind]] = frozenset({"scene", "human", "object"})
    moving: ClassVar[bool] = True
    reads_gaussians: ClassVar[bool] = True
    up: str = "clip"
    axes: str = "the world of the clip; cameras are OpenCV's (x right, y down, z forward)"
    units: str = "metres"
    keeps: ClassVar[Mapping[str, str]] = {}
    config: Any

    def __init__(self, config: Any = None) -> None:
        self.config = config or self.Config()

    @abstractmethod
    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        """Write the files of the format into `folder`, which exists and is empty.

        The same request gives the same bytes: no dates, no paths and no random numbers in files.
        Nothing is written outside `folder`. Gradients are off.

        Args:
            progress: called with a share of the work that never falls, and the present work.

        Returns:
            What of the scene the format cannot hold, to the reason: `Exported.omitted`.

        Raises:
            HoigsError: the scene has nothing that the format can hold, or a file is not writable.
        """

    def export(
        self, request: ExportRequest, out: Path, progress: Progress = no_progress
    ) -> Exported:
        """Write the folder `out`. When this raises, `out` is absent, as it was.

        Raises:
            HoigsError: `out` exists, a decoder makes the scene's pictures, which the colours of the
                Gaussians are not, `write` left no file in it, or as `write`.
        """
        if self.reads_gaussians:
            require_own_colors(request.scene, type(self).__name__)
        if out.exists() or out.is_symlink():
            raise HoigsError(f"{out} exists and is not replaced; name another folder to write")
        omitted = self._unsuited(request)
        unfinished = out.with_name(f".{out.name}.{os.getpid()}.part")
        unfinished.mkdir(parents=True)
        try:
            with torch.no_grad():
                omitted |= self.write(request, unfinished, progress)
            paths = sorted(path for path in unfinished.rglob("*") if path.is_file())
            if not paths:
                raise HoigsError(f"{type(self).__name__} wrote no file for {out}")
            said = {"lost": omitted, "supposed": self._supposed(request)}
            text = json.dumps(self.sheet(request) | said, indent=2)
            (unfinished / SHEET).write_text(text + "\n", encoding="utf-8")
            paths.append(unfinished / SHEET)
            sizes = {p.relative_to(unfinished).as_posix(): p.stat().st_size for p in paths}
            progress(1.0, "written")
            unfinished.rename(out)
        except BaseException:
            shutil.rmtree(unfinished)
            raise
        return Exported(out, sizes, omitted, self._supposed(request))

    def _supposed(self, request: ExportRequest) -> dict[str, str]:
        """What the files say that the clip only guesses: `Exported.supposed`."""
        world, found = request.clip.world, {}
        if self.up != "clip" and world.is_guess:
            found["up"] = (
                "the mean upward direction of the cameras, as the clip does not say where up is "
                "and no person in it stands; its floor is not known"
            )
        elif self.up != "clip" and world.floor is None:
            found["floor"] = f"not known: the clip's origin stays at {self.up} = 0"
        if not world.metres:
            found["unit"] = "the clip's own, taken for a metre: its size in metres is not known"
        return found

    def _unsuited(self, request: ExportRequest) -> dict[str, str]:
        """Entities of a kind that the format cannot hold, to the reason.

        Raises:
            HoigsError: that is all of them.
        """
        kinds = {name: request.scene.entity(name).kind for name in request.entities}
        held = " and ".join(sorted(self.kinds))
        why = {
            n: f"the format holds {held}, not {k}" for n, k in kinds.items() if k not in self.kinds
        }
        if len(why) == len(kinds):
            there = ", ".join(f"{name} ({kind})" for name, kind in kinds.items())
            raise HoigsError(
                f"{type(self).__name__} exports entities of kind {held}; it was given {there}"
            )
        return why

    def sheet(self, request: ExportRequest) -> dict[str, object]:
        """What `export.json` says of an export, but for what was lost."""
        last = request.clip.num_frames - 1
        moments = request.moments if self.moving else request.moments[:1]
        held = [n for n in request.entities if request.scene.entity(n).kind in self.kinds]
        return {
            "exporter": type(self).__name__,
            "clip": request.clip.name,
            "entities": {name: request.scene.entity(name).kind for name in held},
            "frames": [round(moment.time * last, 6) for moment in moments],
            "fps": request.fps if self.moving else None,
            "units": self.units,
            "axes": self.axes,
            "world": request.clip.world.to_dict(),
            "kept": dict(self.keeps),
        }
