"""exporter:ply-sequence: the Gaussians of every moment, a PLY in the layout of 3DGS each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.progress import Progress
from hoigs.plugins.exporters.common.ply_file import ply_bytes
from hoigs.plugins.exporters.common.world import AXES, Up, world_move


class PlySequenceConfig(ComponentConfig):
    """Settings of `exporter:ply-sequence`."""

    up: Up = "clip"
    """"y" or "z" turns the world, SH too, so that this axis points up; "clip" leaves it"""
    pad_sh: bool = False
    """45 f_rest in every file, as `exporter:ply` writes them; without, files are smaller"""
    merged: bool = True
    """one file a moment; false makes a folder for each entity"""


class PlySequenceExporter(Exporter):
    """`frame_0000.ply`, `frame_0001.ply` …, or these in a folder for each entity.

    A Gaussian is at the same row of every file.
    """

    Config: ClassVar[type[ComponentConfig]] = PlySequenceConfig
    keeps: ClassVar = {
        "means": "float32, world", "rotations": "unit quaternions wxyz",
        "scales": "natural logarithms", "opacities": "logits", "colours": "all SH bands",
        "rows": "a Gaussian is at the same row of every file",
    }  # fmt: skip

    def __init__(self, config: PlySequenceConfig | None = None) -> None:
        self.config = config or PlySequenceConfig()
        self.up = self.config.up
        self.axes = AXES[self.up]

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        """See `Exporter.write`."""
        move = world_move(request.clip, self.config.up)
        for i, moment in enumerate(request.moments):
            progress(i / len(request.moments), f"moment {i + 1} of {len(request.moments)}")
            state = request.scene(moment, request.entities)
            parts = {"": state.joined()} if self.config.merged else state.gaussians
            for name, gaussians in parts.items():
                (folder / name).mkdir(exist_ok=True)
                data = ply_bytes(move.gaussians(gaussians), pad_sh=self.config.pad_sh)
                (folder / name / f"frame_{i:04d}.ply").write_bytes(data)
        if self.config.merged and len(request.entities) > 1:
            return {"entities": "one list of Gaussians; --set merged=false keeps them apart"}
        return {}
