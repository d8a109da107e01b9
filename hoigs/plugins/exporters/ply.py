"""exporter:ply: the Gaussians of one moment in the layout of 3DGS, which most viewers open."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.posed import TurnedExporter, Up, world_move

# PLY files of Gaussians in the layout of 3DGS (Kerbl et al. 2023): written and read back.

SIZES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1"}
FULL_SH = 16  # coefficients a channel of degree 3


def columns(coefficients: int) -> list[str]:
    """The properties of a vertex, in order, for K SH coefficients a colour channel."""
    rest = [f"f_rest_{k}" for k in range(3 * (coefficients - 1))]
    return [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity",
        "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
    ]  # fmt: skip


def ply_bytes(gaussians: Gaussians, *, pad_sh: bool = False) -> bytes:
    """A binary PLY of raw values: log-scales, opacity logits, wxyz, float32.

    Coefficients after the first lie channel by channel, as 3DGS stores them.

    Args:
        pad_sh: add SH bands of zeros up to degree 3, which 3DGS's own loader asserts.
    """
    g = gaussians.detach().to("cpu", torch.float32)
    sh = g.sh
    if pad_sh:
        sh = torch.nn.functional.pad(sh, (0, 0, 0, max(0, FULL_SH - sh.shape[1])))
    names = columns(sh.shape[1])
    rest = sh[:, 1:].mT.reshape(len(g), -1)
    quats = torch.nn.functional.normalize(g.quats, dim=-1)
    parts: list[Tensor] = [
        g.means, torch.zeros_like(g.means), g.sh[:, 0], rest, g.opacity_logits[:, None],
        g.log_scales, quats,
    ]  # fmt: skip
    table = torch.cat(parts, 1).contiguous().numpy().astype("<f4", copy=False)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def parse_ply(data: bytes, name: str = "PLY") -> Gaussians:
    """The raw Gaussians of a binary PLY in the layout of 3DGS.

    Raises:
        HoigsError: the bytes are damaged, or no PLY of Gaussians.
    """
    head, end, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    fields = [(line[2], SIZES.get(line[1], "")) for line in lines if line[:1] == ["property"]]
    count = [int(line[2]) for line in lines if line[:2] == ["element", "vertex"]]
    known = {n for n, kind in fields if kind}
    if not end or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]] or not count:
        raise HoigsError(f"{name}: expected a binary little-endian PLY with vertices")
    missing = sorted(set(columns(1)) - {"nx", "ny", "nz"} - known)
    if missing or len(known) != len(fields):
        raise HoigsError(f"{name}: no PLY of Gaussians: {missing or 'list properties'}")
    kind = np.dtype(fields)
    if len(body) < kind.itemsize * count[0]:
        raise HoigsError(f"{name} is damaged: it ends before its {count[0]} vertices do")
    table = np.frombuffer(io.BytesIO(body).read(kind.itemsize * count[0]), kind)

    def take(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([table[n].astype(np.float32) for n in names], -1))

    rest = sorted((n for n in known if n.startswith("f_rest_")), key=lambda n: int(n[7:]))
    sh = take("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        bands = take(*rest).reshape(count[0], 3, len(rest) // 3)
        sh = torch.cat((sh, bands.mT), 1)
    return Gaussians(
        means=take("x", "y", "z"),
        quats=take("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=take("scale_0", "scale_1", "scale_2"),
        opacity_logits=take("opacity")[:, 0],
        sh=sh,
    )


class PlyConfig(ComponentConfig):
    """Settings of `exporter:ply`."""

    up: Up = "clip"
    """"y" or "z" turns the world, SH too, so that this axis points up; "clip" leaves it"""
    pad_sh: bool = True
    """45 f_rest whatever the run's SH degree, the rest zeros: the original 3DGS viewers and loaders
    open nothing else; false leaves out the zeros"""


class PlyExporter(TurnedExporter):
    """`scene.ply`: all entities that are exported, joined, at the first moment."""

    Config: ClassVar = PlyConfig
    config: PlyConfig
    suffixes = (".ply",)
    moving: ClassVar = False
    keeps: ClassVar = {
        "means": "float32, world", "rotations": "unit quaternions wxyz",
        "scales": "natural logarithms", "opacities": "logits", "colours": "all SH bands",
    }  # fmt: skip

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        progress(0.0, "gaussians")
        state = request.scene(request.moments[0].to(request.scene.device), request.entities)
        move = world_move(request.clip, self.config.up)
        data = ply_bytes(move.gaussians(state.joined()), pad_sh=self.config.pad_sh)
        progress(0.5, "writing")
        (folder / "scene.ply").write_bytes(data)
        lost = {
            "the Gaussians' entities": "all are one list; --entities exports those of one entity"
        }
        if len(request.entities) < 2:
            lost = {}
        if len(request.moments) > 1:
            lost["motion"] = "a PLY holds one moment, the first; ply-sequence holds all"
        return lost


# exporter:ply-sequence: the Gaussians of every moment, a PLY in the layout of 3DGS each.


class PlySequenceConfig(ComponentConfig):
    """Settings of `exporter:ply-sequence`."""

    up: Up = "clip"
    """"y" or "z" turns the world, SH too, so that this axis points up; "clip" leaves it"""
    pad_sh: bool = False
    """45 f_rest in every file, as `exporter:ply` writes them; without, files are smaller"""
    merged: bool = True
    """one file a moment; false makes a folder for each entity"""


class PlySequenceExporter(TurnedExporter):
    """`frame_0000.ply`, `frame_0001.ply` …, or these in a folder for each entity.

    A Gaussian is at the same row of every file.
    """

    Config: ClassVar = PlySequenceConfig
    config: PlySequenceConfig
    keeps: ClassVar = {
        "means": "float32, world", "rotations": "unit quaternions wxyz",
        "scales": "natural logarithms", "opacities": "logits", "colours": "all SH bands",
        "rows": "a Gaussian is at the same row of every file",
    }  # fmt: skip

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
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
            return {
                "the Gaussians' entities": "all are one list; --set merged=false keeps them apart"
            }
        return {}
