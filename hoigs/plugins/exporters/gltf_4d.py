"""exporter:gltf-4d: a run as one glTF file that plays: skins, nodes and morph targets of Gaussians.

Each entity is a mesh of points by KHR_gaussian_splatting with the types of KHR_mesh_quantization:
what stands still once, an object once on an animated node, a person once on a skin. What joints do
not explain is a few morph targets (docs/reference/exports.md, "gltf-4d").
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.between import camera_between, frame_of
from hoigs.plugins.exporters.carried import FLOORS, Carried, Entity, collect, quantised, rigid_joint
from hoigs.plugins.exporters.glb import (
    KERNEL,
    NAME,
    VERTICES,
    Clock,
    Glb,
    add_bones,
    add_camera,
    add_skin,
    continuous,
    linear_color,
    xyzw,
)
from hoigs.plugins.exporters.posed import AXES, BodyMotion, ObjectMotion, world_move

EXTENSION = "HOIGS_gaussian_motion"
FINE = 2e-4  # metres; steps of positions and sizes that are coarser are stored as float32
TARGETS = {"quats": "ROTATION", "log_scales": "SCALE", "opacity": "OPACITY", "color": "COLOR"}


class Gltf4dConfig(ComponentConfig):
    """Settings of `exporter:gltf-4d`."""

    modes: int = Field(default=24, ge=0, le=64)
    """morph targets of each entity at the most: what is not a motion of its joints"""
    sh: bool = True
    """colours of what stands still change with the direction, for players that know the extension;
    a third of the file"""


class Gltf4dExporter(Exporter):
    """`scene.glb`: Gaussians that move, in one file that a browser plays."""

    Config: ClassVar = Gltf4dConfig
    config: Gltf4dConfig
    suffixes = (".glb",)
    up = "y"
    axes = AXES["y"]
    keeps: ClassVar = {
        "means": "16 bits, of still, rigid or skinned Gaussians, and morph targets",
        "rotations": "8 bits, xyzw", "scales": "16 bits", "opacities": "16 bits",
        "colours": "band 0 in float32; the other bands of what is still in 8 bits",
        "camera": "of the video, animated",
    }  # fmt: skip

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        entities = collect(request, self.config.modes, progress)
        progress(0.9, "writing")
        (folder / "scene.glb").write_bytes(motion_glb(request, entities, sh=self.config.sh))
        return losses(request, entities)


def losses(request: ExportRequest, entities: Sequence[Entity]) -> dict[str, str]:
    """What of the run is not in the file, to the reason."""
    lost = {}
    for entity in entities:
        part = entity.carried
        if not part.still:
            lost[f"motion of {part.name}"] = (
                f"{part.coefficients.shape[1]} morph targets leave {part.left_mm:.2f} mm and "
                f"{255 * part.left_color:.1f}/255 of colour (RMS)"
            )
            if request.scene.entity(part.name).canonical.sh.shape[1] > 1:
                lost[f"SH of {part.name}"] = "one colour a moment, the mean over the cameras"
    return lost


def motion_glb(request: ExportRequest, entities: Sequence[Entity], *, sh: bool = True) -> bytes:
    """The file."""
    glb = Glb()
    glb.document["extensionsUsed"] = [NAME, "KHR_mesh_quantization", EXTENSION]
    glb.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    seconds = np.arange(len(request.moments), dtype=np.float32) / np.float32(request.fps)
    clock = Clock(glb, glb.accessor(seconds))
    nodes: list[int] = []
    for entity in entities:
        if len(entity.carried):
            nodes += _add_entity(clock, entity, sh=sh)
    move = world_move(request.clip, "y")
    frames = [frame_of(request.clip, moment) for moment in request.moments]
    cameras = [camera_between(request.clip, frame).to("cpu") for frame in frames]
    turn = torch.eye(4)
    turn[:3, :3], turn[:3, 3] = move.turn, move.shift
    camera = add_camera(
        clock, [replace(c, world_to_camera=c.world_to_camera @ turn.inverse()) for c in cameras]
    )
    lenses = [[float(c.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))] for c in cameras]
    glb.document["extensions"] = {
        EXTENSION: {
            "lowPass": request.scene.low_pass,
            "antialiased": request.scene.antialiased,
            "camera": camera,
            "size": [cameras[0].width, cameras[0].height],
            "intrinsics": lenses[:1] if all(k == lenses[0] for k in lenses) else lenses,
        }
    }
    glb.add("scenes", nodes=[*nodes, camera], name=request.clip.name)
    glb.document["scene"] = 0
    return glb.whole()


def _add_entity(clock: Clock, entity: Entity, *, sh: bool) -> list[int]:
    """The mesh of an entity and what carries it; gives the nodes for the scene."""
    glb, part, motion = clock.glb, entity.carried, entity.motion
    means = part.gaussians.means
    low, size = means.amin(0), max(float((means.amax(0) - means.amin(0)).max()), 1e-6)
    mesh, shares = _add_mesh(glb, entity, low, size, sh=sh)
    if isinstance(motion, BodyMotion):
        joints = add_bones(clock, motion)
        skin = add_skin(glb, joints, motion, low.numpy(), size)
        node, roots = glb.add("nodes", name=part.name, mesh=mesh, skin=skin), [joints[0]]
        roots.append(node)
    else:
        node = glb.add(
            "nodes", name=part.name, mesh=mesh, translation=low.tolist(), scale=[size] * 3
        )
        roots = [node]
        if motion is not None:
            quats = continuous(xyzw(_quats(motion))[:, None])[:, 0]
            place = motion.translations[0].tolist()
            above = glb.add(
                "nodes", name=f"{part.name}.pose", rotation=quats[0].tolist(), translation=place,
                children=[node],
            )  # fmt: skip
            clock.move(above, "rotation", quats)
            clock.move(above, "translation", motion.translations.numpy())
            roots = [above]
    if shares.shape[1]:
        glb.document["meshes"][mesh]["weights"] = shares[0].tolist()
        clock.move(node, "weights", shares.numpy().reshape(-1))
    return roots


def _quats(motion: ObjectMotion) -> Float[Tensor, "F 4"]:
    return rigid_joint(motion).turns[:, 0]


def _add_mesh(
    glb: Glb, entity: Entity, low: Float[Tensor, " 3"], size: float, *, sh: bool
) -> tuple[int, Float[Tensor, "F K"]]:
    """The mesh of an entity, whose positions times `size` plus `low` are metres, and the weights of
    its morph targets.

    Joints that enlarge a person enlarge the Gaussians, too.
    """
    part, motion = entity.carried, entity.motion
    skinned = isinstance(motion, BodyMotion)
    grown = motion.scale if isinstance(motion, BodyMotion) else 1.0
    g = part.gaussians
    fine = size / 65535 < FINE
    quats = torch.nn.functional.normalize(g.quats, dim=-1)[:, [1, 2, 3, 0]].numpy()
    color = torch.cat((g.colors.clamp(0, 1), g.opacities[:, None]), 1).numpy()
    color[:, :3] = linear_color(color[:, :3])
    whole = {
        "POSITION": _share(((g.means - low) / size).numpy(), fine),
        f"{NAME}:SCALE": _share((g.scales / (size * grown)).numpy(), fine),
        f"{NAME}:ROTATION": np.round(quats * 127).astype(np.int8),
        f"{NAME}:OPACITY": _share(g.opacities.numpy(), True),
        "COLOR_0": np.round(color * 255).astype(np.uint8),
        f"{NAME}:SH_DEGREE_0_COEF_0": g.sh[:, 0].numpy(),
    }
    if skinned:
        whole["WEIGHTS_0"] = quantised(part.weights).numpy().astype(np.uint16)
        carries = whole["WEIGHTS_0"] > 0
        whole["JOINTS_0"] = np.where(carries, part.joints.numpy(), 0).astype(np.uint8)
    attributes = {
        key: glb.accessor(
            value, VERTICES, normalized=value.dtype != np.float32 and key != "JOINTS_0"
        )
        for key, value in whole.items()
    }
    more = _More()
    targets, shares = _targets(glb, part, size, more)
    if sh and g.sh.shape[1] > 1:
        more.entry["sh"] = {"degree": g.sh_degree, **more.part(g.sh[:, 1:].flatten(1).numpy(), 1.0)}
    kernel = {**KERNEL, "extensions": {EXTENSION: more.stored(glb)}} if more.entry else KERNEL
    shape: dict[str, Any] = {"attributes": attributes, "mode": 0, "extensions": {NAME: kernel}}
    if targets:
        shape["targets"] = targets
    return glb.add("meshes", name=part.name, primitives=[shape]), shares


class _More:
    """What the extension has of one mesh: signed bytes, deflated together (RFC 1950).

    Each part is stored component by component: [d, N].
    """

    def __init__(self) -> None:
        self.entry: dict[str, Any] = {}
        self._data = bytearray()

    def part(
        self, values: Float[np.ndarray, "N d"], unit: float, least: float = 0.0
    ) -> dict[str, Any]:
        """Append a part; `step` times a byte / 127 are its values, divided by `unit`.

        Args:
            least: change that is worth a bit: small numbers then deflate well.
        """
        codes, peak = _bytes(values, 127 * least)
        place = {"offset": len(self._data), "step": peak / unit}
        self._data += np.ascontiguousarray(codes.T).tobytes()
        return place

    def stored(self, glb: Glb) -> dict[str, Any]:
        """The entry, whose bytes are put in the file."""
        return {"bufferView": glb.view(zlib.compress(bytes(self._data), 9)), **self.entry}


def _targets(
    glb: Glb, part: Carried, size: float, more: _More
) -> tuple[list[dict[str, int]], Float[Tensor, "F K"]]:
    """Morph targets: of POSITION as glTF has them, of the rest for the extension; and weights.

    Displacements are bytes whose largest is 1, so weights have the unit of POSITION.
    """
    count, modes = part.coefficients.shape[1], part.modes
    used = [k for k in modes if count and modes[k].any()]
    moving, targets, shares = "means" in used, [], []
    fixed = None if moving or not count else glb.zeros(len(part))
    for k in range(count):
        peak = float(modes["means"][k].abs().max()) if moving else 0.0
        share = max(peak, 1e-6) / size
        shares.append(part.coefficients[:, k] * share)
        if fixed is None:
            codes = _bytes(modes["means"][k].numpy())[0]
            targets.append({"POSITION": glb.accessor(codes, VERTICES, normalized=True)})
        else:
            targets.append({"POSITION": fixed})
        change = {}
        for key in (key for key in used if key != "means"):
            values = modes[key][k]
            values = values[:, [1, 2, 3, 0]] if key == "quats" else values
            change[TARGETS[key]] = more.part(values.numpy(), share, FLOORS[key])
        if change:
            more.entry.setdefault("targets", []).append(change)
    return targets, torch.stack(shares, 1) if shares else part.coefficients


def _share(values: np.ndarray, fine: bool) -> np.ndarray:
    """Numbers in [0, 1] as 16 bits, or as they are."""
    if not fine:
        return values.astype(np.float32)
    return np.round(values.clip(0, 1) * 65535).astype(np.uint16)


def _bytes(values: np.ndarray, least: float = 0.0) -> tuple[np.ndarray, float]:
    """Numbers as signed bytes, and what 127 stands for, at least `least`."""
    peak = max(float(np.abs(values).max()) if values.size else 0.0, least)
    return np.round(values / max(peak, 1e-12) * 127).astype(np.int8), peak
