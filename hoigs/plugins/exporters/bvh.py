"""exporter:bvh: the skeleton of each person as motion capture (Biovision hierarchy)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.reporting import Progress
from hoigs.plugins.exporters.posed import BodyMotion, TurnedExporter, Up, body_motions, world_move


class BvhConfig(ComponentConfig):
    """Settings of `exporter:bvh`."""

    up: Up = "y"
    """the axis that points upward; "clip" leaves the world as the cameras have it"""
    unit: Literal["m", "cm"] = "m"
    """unit of lengths"""


class BvhExporter(TurnedExporter):
    """`NAME.bvh` for each person: bones of the body's shape, rotations in the order Z X Y."""

    Config: ClassVar = BvhConfig
    config: BvhConfig
    suffixes = (".bvh",)
    kinds: ClassVar = frozenset({"human"})
    reads_gaussians: ClassVar = False
    keeps: ClassVar = {
        "joints": "positions of all, from bone lengths and rotations in degrees",
        "poses": "as they are drawn: refined, and corrected by the interaction",
    }

    def __init__(self, config: BvhConfig | None = None) -> None:
        super().__init__(config)
        self.units = {"m": "metres", "cm": "centimetres"}[self.config.unit]

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        progress(0.0, "poses")
        move = world_move(request.clip, self.config.up)
        for motion in body_motions(request):
            text = bvh_text(
                motion.moved(move), request.fps, 100.0 if self.config.unit == "cm" else 1.0
            )
            (folder / f"{motion.name}.bvh").write_text(text, encoding="ascii")
        return {
            "surface": "a skeleton has none; gltf-body holds it",
            "looks": "a skeleton has none; ply-sequence holds them",
        }


def bvh_text(motion: BodyMotion, fps: float, unit: float) -> str:
    """The file. unit: file units per metre."""
    parents, names = motion.body.parents, motion.body.joint_names
    rest = motion.rest_joints.double().numpy() * motion.scale * unit
    children: list[list[int]] = [[] for _ in parents]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, order = ["HIERARCHY"], []

    def bone(joint: int, depth: int) -> None:
        order.append(joint)
        pad, root = "\t" * depth, parents[joint] < 0
        offset = np.zeros(3) if root else rest[joint] - rest[parents[joint]]
        place = "Xposition Yposition Zposition " if root else ""
        lines.extend(
            (
                f"{pad}{'ROOT' if root else 'JOINT'} {names[joint]}",
                f"{pad}{{",
                f"{pad}\tOFFSET {_numbers(offset)}",
                f"{pad}\tCHANNELS {6 if root else 3} {place}Zrotation Xrotation Yrotation",
            )
        )
        for child in children[joint]:
            bone(child, depth + 1)
        if not children[joint]:
            tip = (rest[joint] - rest[parents[joint]]) * 0.5
            lines.extend((
                f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {_numbers(tip)}", f"{pad}\t}}",
            ))  # fmt: skip
        lines.append(f"{pad}}}")

    bone(0, 0)
    lines += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1 / fps:.8f}"]
    lines += [_numbers(row) for row in _channels(motion, order, unit)]
    return "\n".join(lines) + "\n"


def _channels(motion: BodyMotion, order: list[int], unit: float) -> np.ndarray:
    """Root position and the angles of all joints, in the order of the hierarchy, degrees."""
    from scipy.spatial.transform import Rotation

    turns = motion.rotations[:, order].double().numpy()
    angles = Rotation.from_rotvec(turns.reshape(-1, 3)).as_euler("ZXY", degrees=True)
    places = motion.pelvis.double().numpy() * unit
    return np.concatenate((places, angles.reshape(len(motion), -1)), 1)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{x:.6f}" for x in values + 0.0)
