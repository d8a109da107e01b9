"""Exporter: a trained scene, its clip and some moments to files of another program's format."""

from __future__ import annotations

import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import torch

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.model.scene import SceneModel
from hoigs.core.progress import Progress, no_progress
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment


@dataclass(frozen=True)
class ExportRequest:
    """What is exported.

    Attributes:
        scene: the trained model. An exporter changes neither its parameters nor its mode.
        clip: what the model was trained on: cameras, points, bodies, frame rate.
        moments: at which the scene is exported, times ascending. A format without motion may take
            the first one, and then reports the others in `Exported.omitted`.
        entities: names of the entities to export, in the scene's order; empty for all.

    Raises:
        ValueError: no moments, times that do not ascend, or an entity that the scene lacks.
    """

    scene: SceneModel
    clip: Clip
    moments: tuple[Moment, ...]
    entities: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        times = [moment.time for moment in self.moments]
        if not times or any(b <= a for a, b in pairwise(times)):
            raise ValueError(f"times to export are {times}, expected one or more that ascend")
        known = self.scene.names()
        for name in self.entities:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(f'the scene has no entity "{name}"{hint} (it has {known})')
        chosen = tuple(n for n in known if not self.entities or n in self.entities)
        object.__setattr__(self, "entities", chosen)


@dataclass(frozen=True)
class Exported:
    """What an export has written.

    Attributes:
        folder: the new folder.
        files: path of each file below `folder`, with "/", to its size in bytes.
        omitted: what of the scene the format cannot hold, to the reason.
    """

    folder: Path
    files: Mapping[str, int]
    omitted: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        lines = [f"{self.folder / name}: {size} bytes" for name, size in self.files.items()]
        return "\n".join([*lines, *(f"not exported: {k}: {v}" for k, v in self.omitted.items())])


class Exporter(Configurable, ABC):
    """One file format.

    A subclass writes `write`. Callers use `export`, which makes the folder appear complete or not
    at all.
    """

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
            HoigsError: `out` exists, `write` left no file in it, or as `write`.
        """
        if out.exists() or out.is_symlink():
            raise HoigsError(f"{out} exists and is not replaced; name another folder to write")
        unfinished = out.with_name(f".{out.name}.{os.getpid()}.part")
        unfinished.mkdir(parents=True)
        try:
            with torch.no_grad():
                omitted = dict(self.write(request, unfinished, progress))
            paths = sorted(path for path in unfinished.rglob("*") if path.is_file())
            if not paths:
                raise HoigsError(f"{type(self).__name__} wrote no file for {out}")
            sizes = {p.relative_to(unfinished).as_posix(): p.stat().st_size for p in paths}
            progress(1.0, "written")
            unfinished.rename(out)
        except BaseException:
            shutil.rmtree(unfinished)
            raise
        return Exported(out, sizes, omitted)
