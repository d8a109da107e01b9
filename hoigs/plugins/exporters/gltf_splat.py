"""exporter:gltf-splat: the Gaussians of one moment as glTF's KHR_gaussian_splatting."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import torch

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.progress import Progress
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.common.glb import VERTICES, Glb
from hoigs.plugins.exporters.common.world import AXES, world_move

NAME = "KHR_gaussian_splatting"


class GltfSplatConfig(ComponentConfig):
    """`exporter:gltf-splat` has no settings."""


class GltfSplatExporter(Exporter):
    """`splats.glb`: one point primitive for each entity.

    It is written as the release candidate and the ratified text of the extension have it, with
    scales in metres; drafts before had their logarithms. Few programs read it yet.
    """

    Config: ClassVar[type[ComponentConfig]] = GltfSplatConfig
    suffixes = (".glb",)
    moving: ClassVar = False
    up = "y"
    axes = AXES["y"]
    keeps: ClassVar = {
        "means": "POSITION", "rotations": "unit quaternions xyzw", "opacities": "in [0, 1]",
        "scales": "standard deviations", "colours": "all SH bands, srgb_rec709_display",
    }  # fmt: skip

    def __init__(self, config: GltfSplatConfig | None = None) -> None:
        self.config = config or GltfSplatConfig()

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        """See `Exporter.write`."""
        progress(0.0, "gaussians")
        move = world_move(request.clip, "y")
        state = request.scene(request.moments[0], request.entities)
        glb = Glb()
        glb.document["extensionsUsed"] = [NAME]
        nodes = []
        for name, gaussians in state.gaussians.items():
            if len(gaussians):
                mesh = add_splats(glb, name, move.gaussians(gaussians))
                nodes.append(glb.add("nodes", name=name, mesh=mesh))
        glb.add("scenes", nodes=nodes)
        glb.document["scene"] = 0
        progress(0.5, "writing")
        (folder / "splats.glb").write_bytes(glb.bytes())
        lost = {"support": f"{NAME} is new: programs without it show coloured points"}
        if len(request.moments) > 1:
            lost["motion"] = "the extension holds one moment, the first; usd holds all"
        return lost


def add_splats(glb: Glb, name: str, gaussians: Gaussians) -> int:
    """The mesh of one entity."""
    g = gaussians.detach().to("cpu", torch.float32)
    quats = torch.nn.functional.normalize(g.quats, dim=-1)[:, [1, 2, 3, 0]]
    fallback = torch.cat((g.colors.clamp(0, 1), g.opacities[:, None]), 1)
    values = {
        "POSITION": g.means,
        "COLOR_0": fallback,
        f"{NAME}:ROTATION": quats,
        f"{NAME}:SCALE": g.scales,
        f"{NAME}:OPACITY": g.opacities,
    }
    for degree in range(g.sh_degree + 1):
        for k in range(2 * degree + 1):
            values[f"{NAME}:SH_DEGREE_{degree}_COEF_{k}"] = g.sh[:, degree * degree + k]
    attributes = {
        key: glb.accessor(value.float().numpy(), VERTICES) for key, value in values.items()
    }
    extension = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance", "projection": "perspective",
    }  # fmt: skip
    shape = {"attributes": attributes, "mode": 0, "extensions": {NAME: extension}}
    return glb.add("meshes", name=name, primitives=[shape])
