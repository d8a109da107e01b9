"""L_face, the mesh-based facial consistency term (HOIGS, supplement; ExAvatar, Moon et al. 2024).

ExAvatar draws the face's mesh, at the Gaussians' positions, with a texture unwrapped from the video
and compares that with the frame: a face in the wrong place then shows at once, which blurred
Gaussians would hide. Here the texture is unwrapped once, from the training frames and the poses
that the clip brings; a step looks up the frame where each textured point lands, instead of drawing
triangles between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import Clip, Frame
from hoigs.core.deformation import ProvidesFace
from hoigs.core.entity import Entity
from hoigs.core.gaussians import Gaussians
from hoigs.core.scene import SceneModel

FRAMES = 24  # a median over more changes nothing visible
ENOUGH = 8  # points seen, below which a frame says nothing of the face
FACING = 0.4  # cosine between normal and direction to the camera


@dataclass(frozen=True)
class FaceTexture:
    """Colours of T points on a face, at rest.

    Attributes:
        points: canonical, metres. colors: RGB in [0, 1].
    """

    points: Float[Tensor, "T 3"]
    colors: Float[Tensor, "T 3"]

    def at(self, points: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
        """Colours at canonical points: that of the nearest textured one."""
        return self.colors[torch.cdist(points, self.points).argmin(1)]


def unwrap_faces(model: SceneModel, clip: Clip) -> dict[str, FaceTexture]:
    """The texture of every human's face, from the training frames and the model as it is now.

    Raises:
        ValueError: no human in the model has a face, or none is ever seen.
    """
    textures = {}
    for name in model.names("human"):
        entity = model.entity(name)
        if isinstance(entity.deformation, ProvidesFace):
            texture = _unwrap(name, entity, clip)
            if texture is not None:
                textures[name] = texture
    if not textures:
        raise ValueError(
            "train.loss.face asks for a face, but no human of this model has one that a training "
            "frame sees from the front; set it to 0"
        )
    return textures


@torch.no_grad()
def _unwrap(name: str, entity: Entity, clip: Clip) -> FaceTexture | None:
    """Median colour of each point over the frames that see it."""
    assert isinstance(entity.deformation, ProvidesFace)
    train = list(clip.split["train"])
    rows = entity.deformation.face_points()[0]
    samples = []
    for position in train[:: max(1, len(train) // FRAMES)]:
        frame = clip[position]
        device = entity.means.device
        posed = entity(frame.moment.to(device))
        camera, image = frame.camera.to(device), frame.rgb.to(device)
        pixels, seen = face_pixels(entity, posed, camera, visible(frame, name).to(device))
        colors = torch.full((len(rows), 3), torch.nan, device=device)
        colors[seen] = lookup(image, pixels[seen])
        samples.append(colors)
    stacked = torch.stack(samples)
    known = torch.isfinite(stacked[..., 0]).any(0)
    if int(known.sum()) < ENOUGH:
        return None
    colors = stacked[:, known].nanmedian(0).values
    return FaceTexture(entity.means.detach()[rows[known]].clone(), colors)


def visible(frame: Frame, name: str) -> Bool[Tensor, "H W"]:
    """Pixels in which a frame shows this human, and shows anything at all."""
    mask = frame.masks[name]
    return mask if frame.ignored is None else mask & ~frame.ignored


def face_pixels(
    entity: Entity, posed: Gaussians, camera: Camera, mask: Bool[Tensor, "H W"]
) -> tuple[Float[Tensor, "F 2"], Bool[Tensor, " F"]]:
    """Where the face's points land, pixels, and which of them the camera sees.

    Seen is what faces the camera and lands in the mask of visible pixels; a hand of the same human
    before the face is not told from it. Pixels carry the gradient of the posed means.
    """
    assert isinstance(entity.deformation, ProvidesFace)
    rows, normals = entity.deformation.face_points()
    points = posed.means[rows]
    pixels, depth = camera.project(points)
    with torch.no_grad():
        turn = rigid_rotation(entity.means[rows], points)
        towards = torch.nn.functional.normalize(camera.center - points, dim=-1)
        at = pixels.floor().long()
        size = at.new_tensor((camera.width, camera.height))
        seen = ((at >= 0) & (at < size)).all(1) & (depth > 1e-3)
        seen &= ((normals @ turn.mT) * towards).sum(-1) > FACING
        at = torch.minimum(at.clamp_min(0), size - 1)
        seen &= mask[at[:, 1], at[:, 0]]
    return pixels, seen


def rigid_rotation(start: Float[Tensor, "F 3"], end: Float[Tensor, "F 3"]) -> Float[Tensor, "3 3"]:
    """The rotation that best takes points onto others (Kabsch, 1976); identity for fewer than 3."""
    if len(start) < 3:
        return torch.eye(3).to(start)
    covariance = (end - end.mean(0)).mT @ (start - start.mean(0))
    u, _, vt = torch.linalg.svd(covariance)
    sign = torch.ones(3).to(start)
    sign[2] = torch.sign(torch.linalg.det(u @ vt))
    return u @ torch.diag(sign) @ vt


def lookup(image: Float[Tensor, "H W 3"], pixels: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Bilinear colours at pixel positions (centres at +0.5), differentiable in the positions."""
    size = pixels.new_tensor((image.shape[1], image.shape[0]))
    grid = (2 * pixels / size - 1)[None, None]
    found = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid, align_corners=False, padding_mode="border"
    )
    return found[0, :, 0].T


def face_loss(
    texture: FaceTexture,
    entity: Entity,
    posed: Gaussians,
    camera: Camera,
    image: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"],
) -> Float[Tensor, ""] | None:
    """Mean |texture - frame| over the face's seen points; None where fewer than 8 are seen.

    Its gradient moves the face: pose, shape, alpha and canonical offsets; colours have none.

    Args:
        posed: the human at this moment. mask: `visible` pixels.
    """
    pixels, seen = face_pixels(entity, posed, camera, mask)
    if int(seen.sum()) < ENOUGH:
        return None
    assert isinstance(entity.deformation, ProvidesFace)
    rows = entity.deformation.face_points()[0][seen]
    colors = texture.at(entity.means.detach()[rows])
    return (lookup(image, pixels[seen]) - colors).abs().mean()
