"""exporter:ply: the Gaussians of one moment in the layout of 3DGS, which most viewers open."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.progress import Progress
from hoigs.plugins.exporters.common.ply_file import ply_bytes
from hoigs.plugins.exporters.common.world import AXES, Up, world_move


class PlyConfig(ComponentConfig):
    """Settings of `exporter:ply`."""

    up: Up = "clip"
    """"y" or "z" turns the world, SH too, so that this axis points up; "clip" leaves it"""
    pad_sh: bool = True
    """45 f_rest whatever the run's SH degree, the rest zeros: the original 3DGS viewers and loaders
    open nothing else; false leaves out the zeros"""


class PlyExporter(Exporter):
    """`scene.ply`: all entities that are exported, joined, at the first moment."""

    Config: ClassVar[type[ComponentConfig]] = PlyConfig
    suffixes = (".ply",)
    moving: ClassVar = False
    keeps: ClassVar = {
        "means": "float32, world", "rotations": "unit quaternions wxyz",
        "scales": "natural logarithms", "opacities": "logits", "colours": "all SH bands",
    }  # fmt: skip

    def __init__(self, config: PlyConfig | None = None) -> None:
        self.config = config or PlyConfig()
        self.up = self.config.up
        self.axes = AXES[self.up]

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        """See `Exporter.write`."""
        progress(0.0, "gaussians")
        state = request.scene(request.moments[0].to(request.scene.device), request.entities)
        move = world_move(request.clip, self.config.up)
        data = ply_bytes(move.gaussians(state.joined()), pad_sh=self.config.pad_sh)
        progress(0.5, "writing")
        (folder / "scene.ply").write_bytes(data)
        lost = {"entities": "one list of Gaussians; export them one by one with --entities"}
        if len(request.entities) < 2:
            lost = {}
        if len(request.moments) > 1:
            lost["motion"] = "a PLY holds one moment, the first; ply-sequence holds all"
        return lost
