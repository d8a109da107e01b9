"""PLY files of Gaussians in the layout of 3DGS (Kerbl et al. 2023): written and read back."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.values.gaussians import Gaussians

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


def read_ply(path: Path | str) -> Gaussians:
    """The Gaussians of a PLY in the layout of 3DGS, raw.

    Raises:
        HoigsError: the file is absent, damaged, or no PLY of Gaussians.
    """
    path = Path(path)
    if not path.is_file():
        raise HoigsError(f"{path}: no such file")
    return parse_ply(path.read_bytes(), str(path))


def parse_ply(data: bytes, name: str = "PLY") -> Gaussians:
    """The Gaussians in the bytes of a binary PLY; errors as `read_ply`."""
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
