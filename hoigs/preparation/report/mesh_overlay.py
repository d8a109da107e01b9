"""A shaded mesh over a picture, by the painter's algorithm: enough to judge a fit."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw
from torch import Tensor

from hoigs.core.values.camera import Camera

TINT = np.array((90, 200, 255))


def overlay_frame(
    image: UInt8[np.ndarray, "H W 3"],
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    strength: float | Float[np.ndarray, "H W"] = 0.6,
) -> UInt8[np.ndarray, "H W 3"]:
    """`image` with a mesh blended over it.

    Args:
        vertices: world, metres. strength: 0 shows only the image, 1 only the mesh; of all pixels
            or of each.
    """
    strength = np.asarray(strength)[..., None]
    with torch.no_grad():
        pixels, depth = camera.project(vertices)
        corners = pixels[faces]
        a, b, c = corners.unbind(1)
        turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        cam = camera.to_camera(vertices)[faces]
        normals = torch.linalg.cross(cam[:, 1] - cam[:, 0], cam[:, 2] - cam[:, 0])
        normals = torch.nn.functional.normalize(normals, dim=-1)
        toward = (normals * torch.nn.functional.normalize(cam.mean(1), dim=-1)).sum(-1)
        middle = depth[faces].mean(1)
        shown = (depth[faces] > 0.05).all(1) & (toward < 0) & (turn.abs() > 1e-6)
        order = middle[shown].argsort(descending=True)
        polygons = corners[shown][order].flatten(1).tolist()
        shade = (0.35 + 0.65 * -toward[shown][order]).clamp(0, 1).numpy()
    layer = Image.fromarray(image)
    draw = ImageDraw.Draw(layer)
    for polygon, light in zip(polygons, shade, strict=True):
        draw.polygon(polygon, fill=tuple((TINT * light).astype(int)))
    mixed = strength * np.asarray(layer, float) + (1 - strength) * image
    return mixed.round().astype(np.uint8)
