"""ClientScene: the Gaussians of a run in the browser, which draws them itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from hoigs.core.maths.rotations import normalize_quats, quats_to_matrices
from hoigs.core.values.gaussians import Gaussians
from hoigs.viewing.player.page import RIGID_M, STEADY, pose_of, remaining, rgba_of
from hoigs.viewing.viewer.controls import Settings
from hoigs.viewing.viewer.run_drawing import RunDrawing

GROWN = 50.0  # viser keeps covariances in float16, in which those of millimetres would be lost
LARGEST = 60_000.0  # of a covariance in it
EYES = 4  # cameras of the video, of which the colours are the mean


@dataclass
class _Sent:
    """What the browser has of an entity: its node, and the Gaussians in it."""

    drawing: RunDrawing
    node: Any
    gaussians: Gaussians
    still: bool


class ClientScene:
    """Nodes of a viser scene, one an entity: what stands still is sent once, a rigid entity moves
    by the pose of its node, and anything else is sent at every moment.

    Colours do not depend on the direction: each is the mean of what cameras of the video see.

    Args:
        scene: viser's.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._sent: dict[str, _Sent] = {}

    @staticmethod
    def draws(settings: Settings) -> bool:
        """Whether the browser can draw this: its colours alone, and one picture."""
        return settings.layout == "one" and settings.mode == "colour"

    @torch.no_grad()
    def update(self, drawing: RunDrawing, frame: float, settings: Settings) -> int:
        """Bring the nodes to a frame number; the number of Gaussians that were sent."""
        shown, count = self.draws(settings), 0
        for name, sent in self._sent.items():
            _put(sent.node, "visible", shown and name in settings.entities)
        if not shown:
            return 0
        everything = drawing.gaussians(frame, settings.interaction)
        cameras = drawing.clip.cameras
        eyes = [camera.center for camera in cameras[:: max(1, len(cameras) // EYES)]]
        for name, rows in drawing.rows().items():
            if name not in settings.entities:
                continue
            had = self._sent.get(name)
            if had is None or had.drawing is not drawing or not had.still:
                count += self._entity(name, drawing, everything[rows].to("cpu").clone(), eyes)
        return count

    def _entity(
        self, name: str, drawing: RunDrawing, gaussians: Gaussians, eyes: list[torch.Tensor]
    ) -> int:
        sent = self._sent.get(name)
        if sent is not None and sent.drawing is drawing and _same_shape(sent.gaussians, gaussians):
            before = sent.gaussians
            pose = pose_of(before.means, gaussians.means)
            quats = [normalize_quats(g.quats) for g in (before, gaussians)]
            if remaining(before.means, quats[0], gaussians.means, quats[1], pose) <= RIGID_M:
                _put(sent.node, "wxyz", tuple(pose[:4].tolist()))
                _put(sent.node, "position", tuple(pose[4:].tolist()))
                return 0
        rotated = quats_to_matrices(normalize_quats(gaussians.quats)) * (
            GROWN * gaussians.log_scales.exp()
        ).unsqueeze(-2)
        covariances = (rotated @ rotated.mT).clamp(-LARGEST, LARGEST)
        rgba = rgba_of(gaussians, eyes).clamp(0, 1)  # viser has 8 bits
        arrays = [
            np.ascontiguousarray(a.float().numpy())
            for a in (GROWN * gaussians.means, covariances, rgba[:, :3], rgba[:, 3:])
        ]
        if sent is None:
            node = self._scene.add_gaussian_splats(f"/splats/{name}", *arrays, scale=1 / GROWN)
        else:
            node = sent.node
            node.set_gaussians(*arrays)
            _put(node, "wxyz", (1.0, 0.0, 0.0, 0.0))
            _put(node, "position", (0.0, 0.0, 0.0))
        model = drawing.loaded.model
        still = not model.entity(name).deformation.moves and (
            model.interaction is None or model.entity(name).kind == "scene"
        )
        self._sent[name] = _Sent(drawing, node, gaussians, still)
        return len(gaussians)


def _same_shape(before: Gaussians, now: Gaussians) -> bool:
    """Whether sizes and opacities are those that were sent."""
    if len(before) != len(now) or len(now) < 3:
        return False
    sizes = (before.log_scales - now.log_scales).abs().max()
    return bool(sizes < STEADY and (before.opacities - now.opacities).abs().max() < STEADY)


def _put(node: Any, name: str, value: Any) -> None:
    """Set a property, without a message where it has the value already."""
    if not np.array_equal(getattr(node, name), value):
        setattr(node, name, value)
