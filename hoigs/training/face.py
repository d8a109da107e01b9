"""L_face, the mesh-based facial consistency term (HOIGS Eq. 16; ExAvatar, Moon et al. 2024).

ExAvatar draws the mesh of the face at the Gaussians' positions, with a texture unwrapped from the
video, and compares it with the frame, so that a misplaced face costs more than blurred Gaussians
would show. Here the texture is unwrapped once, from the training frames and the poses of the clip;
a step then samples the frame where each textured point projects, and draws no triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.interfaces.deformation import ProvidesFace
from hoigs.core.maths.rotations import kabsch
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, Frame
from hoigs.core.values.gaussians import Gaussians

FRAMES = 24  # for the median colours
MIN_POINTS = 8  # seen in a frame, below which the term is skipped
FACING = 0.4  # cosine between normal and direction to the camera


@dataclass(frozen=True)
class FaceTexture:
    """Colours of T canonical points on a face.

    Attributes:
        points: canonical, metres. colors: RGB in [0, 1].
    """

    points: Float[Tensor, "T 3"]
    colors: Float[Tensor, "T 3"]

    def at(self, points: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
        """The colour of the textured point nearest to each canonical point."""
        return self.colors[torch.cdist(points, self.points).argmin(1)]


def unwrap_faces(model: SceneModel, clip: Clip) -> dict[str, FaceTexture]:
    """The texture of every human's face, from the training frames and the model's present poses.

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
            "train.loss.face > 0 needs a face, but no human of this model has one that a training "
            "frame shows from the front; set it to 0"
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
    if int(known.sum()) < MIN_POINTS:
        return None
    colors = stacked[:, known].nanmedian(0).values
    return FaceTexture(entity.means.detach()[rows[known]].clone(), colors)


def visible(frame: Frame, name: str) -> Bool[Tensor, "H W"]:
    """Pixels of a frame that show this human, and that are not ignored."""
    mask = frame.masks[name]
    return mask if frame.ignored is None else mask & ~frame.ignored


def face_pixels(
    entity: Entity, posed: Gaussians, camera: Camera, mask: Bool[Tensor, "H W"]
) -> tuple[Float[Tensor, "F 2"], Bool[Tensor, " F"]]:
    """Projections of the face's points, pixels, and which of them the camera sees.

    A point is seen if it faces the camera and projects into `mask`; a hand of the same human before
    the face is not detected. The pixel positions carry the gradient of the posed means.
    """
    assert isinstance(entity.deformation, ProvidesFace)
    rows, normals = entity.deformation.face_points()
    points = posed.means[rows]
    pixels, depth = camera.project(points)
    with torch.no_grad():
        turn = kabsch(entity.means[rows], points) if len(rows) >= 3 else torch.eye(3).to(points)
        towards = torch.nn.functional.normalize(camera.center - points, dim=-1)
        seen = camera.shows(pixels, depth, near=1e-3)
        seen &= ((normals @ turn.mT) * towards).sum(-1) > FACING
        column, row = torch.where(seen[:, None], pixels, 0).long().unbind(1)
        seen &= mask[row, column]
    return pixels, seen


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
    if int(seen.sum()) < MIN_POINTS:
        return None
    assert isinstance(entity.deformation, ProvidesFace)
    rows = entity.deformation.face_points()[0][seen]
    colors = texture.at(entity.means.detach()[rows])
    return (lookup(image, pixels[seen]) - colors).abs().mean()
