"""Posed bodies of a run or a clip: vertices and joints at any frame number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry
from hoigs.core.values.between import moment_between
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import BodyPose, Moment


@dataclass(frozen=True)
class PosedBody:
    """A person's body over time.

    Attributes:
        faces: triangles. bones: pairs of joints.
    """

    body: BodyModel
    pose: Callable[[Moment], BodyPose]
    clip: Clip

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        array: np.ndarray = self.body.faces.cpu().numpy()
        return array

    @property
    def bones(self) -> Int[np.ndarray, "E 2"]:
        pairs = [(p, j) for j, p in enumerate(self.body.parents) if p >= 0]
        return np.array(pairs)

    @torch.no_grad()
    def at(self, frame: float) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """Vertices and joints at a frame number, world, metres."""
        device = self.body.faces.device
        posed = self.body(self.pose(moment_between(self.clip, frame).to(device)))
        return posed.vertices.cpu().numpy(), posed.joints.cpu().numpy()


def bodies_of_run(model: SceneModel, clip: Clip) -> dict[str, PosedBody]:
    """The bodies that a run's deformations hold, in the poses that training has refined."""
    found = {}
    for name in model.names("human"):
        deformation = model.entity(name).deformation
        body = getattr(deformation, "body", None)
        if isinstance(body, BodyModel) and isinstance(deformation, ProvidesSkeleton):
            found[name] = PosedBody(body, deformation.pose, clip)
    return found


def bodies_of_clip(clip: Clip, registry: Registry) -> tuple[dict[str, PosedBody], dict[str, str]]:
    """The bodies of a clip, and by entity why one cannot be shown."""
    found, missing = {}, {}
    for name, track in clip.bodies.items():
        try:
            config = registry.config_class(track.model)()
            context = BuildContext(entity=name, clip=clip, body_track=track)
            body = registry.concrete(track.model).from_config(config, context)
        except (HoigsError, ValidationError) as error:
            missing[name] = f"no body mesh: {track.model}: {str(error).splitlines()[0]}"
            continue
        found[name] = PosedBody(body, _reader(name), clip)
    return found, missing


def _reader(name: str) -> Callable[[Moment], BodyPose]:
    def pose(moment: Moment) -> BodyPose:
        poses: Mapping[str, BodyPose] = moment.poses
        return poses[name]

    return pose
