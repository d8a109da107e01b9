"""The outline of a posed body in an image."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image, ImageDraw
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose

NEAR = 0.05  # metres; triangles nearer than this are left out


def silhouette(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "T 3"], camera: Camera
) -> Bool[np.ndarray, "H W"]:
    """Pixels that a mesh covers. Only triangles that face the camera are drawn: on a closed mesh
    they cover all.
    """
    xy, depth = camera.project(vertices)
    corners = xy[faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # y points down: a triangle that is counter-clockwise from outside has negative area here
    facing = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) < 0
    ahead = (depth[faces] > NEAR).all(-1)
    image = Image.new("L", (camera.width, camera.height))
    draw = ImageDraw.Draw(image)
    # PIL's integer coordinates are pixel centres
    for triangle in (corners[facing & ahead] - 0.5).reshape(-1, 6).tolist():
        draw.polygon(triangle, fill=255)
    return np.asarray(image) > 0


@torch.no_grad()
def posed(
    body: BodyModel, poses: BodyPose, chunk: int = 32
) -> Iterator[tuple[Float[Tensor, "V 3"], Float[Tensor, "J 3"]]]:
    """Vertices and joints frame by frame, world, metres; a few frames are posed at a time."""
    count = len(poses.transl)
    for start in range(0, count, chunk):
        part = slice(start, min(start + chunk, count))
        some = poses.replace(
            global_orient=poses.global_orient[part],
            body=poses.body[part],
            left_hand=poses.left_hand[part],
            right_hand=poses.right_hand[part],
            transl=poses.transl[part],
        )
        out = body(some)
        yield from zip(out.vertices, out.joints, strict=True)
