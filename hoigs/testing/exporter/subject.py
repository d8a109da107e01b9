"""ExporterSubject: an exporter with its settings, and a tiny scene to export."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.model.entity import Entity
from hoigs.core.model.exporter import Exported, Exporter, ExportRequest
from hoigs.core.model.scene import SceneModel
from hoigs.core.progress import Progress, no_progress
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.tokens import EntityKind
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.testing.checks import CheckList, ComponentSubject
from hoigs.testing.material.body import TinyBody
from hoigs.testing.material.clip import HUMAN, OBJECT, moment_at, tiny_clip
from hoigs.testing.material.motion import TinyMotion

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

COUNT = 12  # Gaussians of each entity
TIMES = (0.0, 0.5, 1.0)


@dataclass(frozen=True)
class ExporterSubject(ComponentSubject[Exporter]):
    """The component under check."""

    def exporter(self) -> Exporter:
        return self.cls.from_config(self.config, BuildContext())

    def request(self, *entities: str) -> ExportRequest:
        """Three moments of a scene with a human and an object, or some of these."""
        scene = SceneModel(
            {HUMAN: _entity(0, "human"), OBJECT: _entity(1, "object")},
            rasterizer=TorchRasterizer(),
        )
        bodies = {HUMAN: TinyBody()}
        return ExportRequest(scene, tiny_clip(), tuple(map(moment_at, TIMES)), entities, bodies)

    def export(
        self,
        out: Path,
        request: ExportRequest | None = None,
        progress: Progress = no_progress,
    ) -> Exported:
        return self.exporter().export(request or self.request(), out, progress)


def _entity(seed: int, kind: EntityKind) -> Entity:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(COUNT, 3, generator=generator) * 0.2 + torch.tensor((0.0, 0.0, 3.0))
    return Entity(Gaussians.from_points(points, opacity=0.5, sh_degree=1), TinyMotion(), kind=kind)


@contextlib.contextmanager
def workplace() -> Iterator[Path]:
    """An empty folder for exports; the working directory is another empty folder."""
    with tempfile.TemporaryDirectory() as root:
        place, elsewhere = Path(root) / "exports", Path(root) / "working-directory"
        place.mkdir()
        elsewhere.mkdir()
        with contextlib.chdir(elsewhere):
            yield place


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder`, hidden ones too, and every folder as b""."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else b""
        for path in sorted(folder.rglob("*"))
    }


CHECKS: CheckList[ExporterSubject] = CheckList("X")


def subject(cls: type[Exporter], config: Any, options: Options) -> ExporterSubject:
    del options
    made = ExporterSubject(cls, config)
    made.exporter()
    return made
