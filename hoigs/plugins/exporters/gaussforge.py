"""exporter:spz, splat, sog and compressed-ply: smaller files of one moment, by GaussForge."""

from __future__ import annotations

import gzip
import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import gaussforge
import torch

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.between import camera_between, frame_of
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.plugins.exporters.ply import parse_ply, ply_bytes
from hoigs.plugins.exporters.posed import Move, eyes_of

FLAGS, ANTIALIASED = 14, 1  # the byte of an SPZ header, and its bit


class GaussForgeExporter(Exporter):
    """One file that GaussForge makes of the PLY; it is read back and compared with it."""

    moving: ClassVar = False
    file_format: ClassVar[str]  # GaussForge's name
    keeps: ClassVar = {"Gaussians": "quantised; the loss is under `lost`"}

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        progress(0.0, "gaussians")
        ours = request.scene(request.moments[0], request.entities).joined()
        data, read = self.packed(self.prepared(ours, request.clip))
        data = self.marked(data, request.scene.antialiased)
        progress(0.5, "comparing")
        (folder / f"scene{self.suffixes[0]}").write_bytes(data)
        if len(read) != len(ours):
            lost = {"Gaussians": f"{len(ours) - len(read)} of {len(ours)} are left out"}
        else:
            lost = {}
        lost["precision"] = picture_loss(request, ours, read)
        if read.sh_degree < ours.sh_degree:
            lost["view-dependent colour"] = (
                f"SH of degree {read.sh_degree} of {ours.sh_degree}: each colour is the mean of "
                "what the cameras of the video see, cut at white"
            )
        if len(request.moments) > 1:
            lost["motion"] = "the file holds one moment, the first; ply-sequence holds all"
        return lost

    def prepared(self, gaussians: Gaussians, clip: Clip) -> Gaussians:
        """What is packed; overridden where the format cannot hold all of it."""
        return gaussians

    def packed(self, gaussians: Gaussians) -> tuple[bytes, Gaussians]:
        """The file, and the Gaussians that GaussForge reads back from it."""
        data = converted(ply_bytes(gaussians), "ply", self.file_format)
        return data, parse_ply(converted(data, self.file_format, "ply"), self.file_format)

    def marked(self, data: bytes, antialiased: bool) -> bytes:
        """The file with its mark of Gaussians that were trained antialiased.

        Overridden where the format has one; GaussForge does not set it.
        """
        return data


class SpzExporter(GaussForgeExporter):
    """`scene.spz`, Niantic's: x right, y up, z backward, where a PLY of 3DGS has y down and z
    forward.
    """

    suffixes = (".spz",)
    file_format = "spz"
    axes = "x right, y up, z backward: those of the clip's world (and of ply) with y and z negated"
    half_turn: ClassVar = Move(torch.diag(torch.tensor((1.0, -1.0, -1.0))), torch.zeros(3))

    def packed(self, gaussians: Gaussians) -> tuple[bytes, Gaussians]:
        """As above; GaussForge itself does not turn the axes of a PLY to SPZ's."""
        data, read = super().packed(self.half_turn.gaussians(gaussians))
        return data, self.half_turn.gaussians(read)

    def marked(self, data: bytes, antialiased: bool) -> bytes:
        """Bit 0 of the header's flags."""
        raw = bytearray(gzip.decompress(data))
        raw[FLAGS] = raw[FLAGS] & ~ANTIALIASED | (ANTIALIASED if antialiased else 0)
        return gzip.compress(bytes(raw), mtime=0)


class SplatExporter(GaussForgeExporter):
    """`scene.splat`, that of the first web viewers: 32 bytes a Gaussian, no SH."""

    suffixes = (".splat",)
    file_format = "splat"

    def prepared(self, gaussians: Gaussians, clip: Clip) -> Gaussians:
        """Colours that do not depend on the direction: band 0 alone is far from what was seen."""
        if gaussians.sh_degree == 0:
            return gaussians
        colors = mean_colors(gaussians.sh, gaussians.means, eyes_of(clip))
        return gaussians.replace(sh=((colors - 0.5) / SH_C0)[:, None])


class SogExporter(GaussForgeExporter):
    """`scene.sog`, PlayCanvas's."""

    suffixes = (".sog",)
    file_format = "sog"

    def marked(self, data: bytes, antialiased: bool) -> bytes:
        """`antialias` in meta.json."""
        made = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(made, "w") as new:
            for name in old.namelist():
                content = old.read(name)
                if name == "meta.json":
                    meta = json.loads(content) | {"antialias": antialiased}
                    content = json.dumps(meta).encode()
                new.writestr(zipfile.ZipInfo(name), content)
        return made.getvalue()


class CompressedPlyExporter(GaussForgeExporter):
    """`scene.compressed.ply`, PlayCanvas's and SuperSplat's."""

    suffixes = (".compressed.ply",)
    file_format = "compressed.ply"

    def packed(self, gaussians: Gaussians) -> tuple[bytes, Gaussians]:
        """As above; SH are written in the order in which they are read.

        GaussForge 0.6 writes them coefficient by coefficient and reads them, as PlayCanvas does,
        channel by channel.
        """
        plain = super().packed(gaussians)
        rest = gaussians.sh[:, 1:]
        if rest.shape[1] == 0:
            return plain
        swapped = rest.mT.reshape(rest.shape)
        other = super().packed(gaussians.replace(sh=torch.cat((gaussians.sh[:, :1], swapped), 1)))
        # rows may be in another order than ours, so the sums of what was read are compared
        total = rest.detach().cpu().double().sum(0)
        errors = [float((r.sh[:, 1:].double().sum(0) - total).norm()) for _, r in (plain, other)]
        return plain if errors[0] <= errors[1] else other


def converted(data: bytes, source: str, target: str) -> bytes:
    """A file in another format.

    Raises:
        HoigsError: GaussForge cannot convert it.
    """
    answer = gaussforge.GaussForge().convert(data, source, target)
    if "data" not in answer:
        raise HoigsError(f"GaussForge cannot write {target}: {answer.get('error', 'no reason')}")
    return answer["data"]


@torch.no_grad()
def picture_loss(request: ExportRequest, ours: Gaussians, read: Gaussians) -> str:
    """PSNR in dB between the pictures of two sets, from the camera of the video."""
    frame = frame_of(request.clip, request.moments[0])
    camera = camera_between(request.clip, frame).to(ours.means.device)
    draw = request.scene.draw
    pictures = [draw(g.to(ours.means.device), camera, RenderRequest()).color for g in (ours, read)]
    error = float((pictures[0] - pictures[1]).square().mean())
    if error == 0:
        return "none that shows from the camera of the video"
    return f"drawn from the camera of the video: {-10 * math.log10(error):.1f} dB (PSNR) to ours"
