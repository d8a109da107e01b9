"""exporter:smplx and exporter:amass: body parameters as arrays, for programs of SMPL's family."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.reporting import Progress
from hoigs.plugins.exporters.posed import BodyMotion, TurnedExporter, Up, body_motions, world_move


class SmplxNpzConfig(ComponentConfig):
    """Settings of `exporter:smplx`."""

    up: Up = "clip"
    """the axis that points upward; "clip" keeps the world of the cameras"""


class AmassConfig(ComponentConfig):
    """Settings of `exporter:amass`."""

    up: Up = "z"
    """the axis that points upward, z in AMASS; "clip" keeps the world of the cameras"""


class _ParametersExporter(TurnedExporter):
    """One npz for each person."""

    suffixes = (".npz",)
    kinds: ClassVar = frozenset({"human"})
    reads_gaussians: ClassVar = False

    Config: ClassVar[type[SmplxNpzConfig | AmassConfig]]
    config: SmplxNpzConfig | AmassConfig

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        progress(0.0, "poses")
        move = world_move(request.clip, self.config.up)
        lost = {"surface details and looks": "the files hold parameters of a body"}
        for motion in body_motions(request):
            turned = motion.moved(move)
            arrays: dict[str, Any] = self.arrays(turned, request)
            np.savez(folder / f"{motion.name}.npz", **arrays)
            lost |= _unlike_smpl(motion, type(self).__name__)
        return lost

    @abstractmethod
    def arrays(self, motion: BodyMotion, request: ExportRequest) -> dict[str, np.ndarray]:
        """The arrays of one person's file by name; poses in radians, places in metres."""


class SmplxExporter(_ParametersExporter):
    """`NAME.npz` with the arguments of an SMPL-X layer, and the joints that they give."""

    Config = SmplxNpzConfig
    keeps: ClassVar = {
        "global_orient, body_pose, left_hand_pose, right_hand_pose": "axis-angle; zero is the "
        "T-pose with flat hands",
        "transl, betas, scale": "metres; the pelvis is at J_0(betas) + transl, the body is scaled "
        "about it",
        "joints": "world positions of the body's own joints",
    }

    def arrays(self, motion: BodyMotion, request: ExportRequest) -> dict[str, np.ndarray]:
        turns = motion.rotations.numpy()
        return {
            "global_orient": turns[:, 0],
            "body_pose": turns[:, 1:22].reshape(len(motion), 63),
            "left_hand_pose": turns[:, -30:-15].reshape(len(motion), 45),
            "right_hand_pose": turns[:, -15:].reshape(len(motion), 45),
            "transl": motion.transl.numpy(),
            "betas": motion.betas.numpy(),
            "scale": np.array(motion.scale, np.float32),
            "joints": torch.stack([motion.joints(i) for i in range(len(motion))]).numpy(),
            "joint_names": np.array(motion.body.joint_names),
            "body_model": np.array(motion.model),
            "gender": np.array(motion.gender or "neutral"),
            "flat_hand_mean": np.array(True),
            "fps": np.array(request.fps, np.float32),
        }


class AmassExporter(_ParametersExporter):
    """`NAME.npz` as AMASS has it (Mahmood et al. 2019): SMPL+H poses of 52 joints."""

    Config = AmassConfig
    keeps: ClassVar = {
        "poses": "axis-angle of 52 joints [F, 156], zero is the T-pose with flat hands",
        "trans, betas": "metres; the pelvis is at J_0(betas) + trans",
        "mocap_framerate, gender": "as AMASS has them",
    }

    def arrays(self, motion: BodyMotion, request: ExportRequest) -> dict[str, np.ndarray]:
        turns = torch.cat((motion.rotations[:, :22], motion.rotations[:, -30:]), 1)
        return {
            "poses": turns.reshape(len(motion), 156).double().numpy(),
            "trans": motion.transl.double().numpy(),
            "betas": motion.betas.double().numpy(),
            "gender": np.array(motion.gender or "neutral"),
            "mocap_framerate": np.array(float(request.fps)),
        }


def _unlike_smpl(motion: BodyMotion, what: str) -> dict[str, str]:
    """What a program with SMPL's own body would show otherwise."""
    lost = {}
    if not motion.model.startswith("body:smpl"):
        lost[f"shape of {motion.name}"] = (
            f"the betas are those of {motion.model}; set them to zero for a body of SMPL's family, "
            "whose joints then lie up to decimetres elsewhere"
        )
    if what == "AmassExporter" and motion.scale != 1.0:
        lost[f"scale of {motion.name}"] = f"the body is drawn {motion.scale:.4f} times as large"
    return lost
