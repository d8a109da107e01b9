"""The size of a person by that of the face, which differs less between adults than their height."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import pinhole_rays

# How far off the nose is, by a face of the mean size.


# landmark -> place of nose, of the eyes' inner corners, middles and outer corners, and of the
# mouth's corners on the left side, metres; x to the person's left, y up, z out of the face. From
# MediaPipe's canonical face model, whose eyes are 89 mm apart at their outer corners, as those of
# adults are (91 and 88 mm of men and women, Farkas 1994).
NOSE = (0.0, -0.0113, 0.0748)  # landmark 0
SIDES = {
    (1, 4): (0.0186, 0.0259, 0.0376),
    (2, 5): (0.0315, 0.0262, 0.0347),
    (3, 6): (0.0444, 0.0266, 0.0317),
    (9, 10): (0.0246, -0.0434, 0.0428),
}
EYES = (3, 6)
VISIBLE = 0.8  # of all these landmarks
TURNED = 0.4  # cosine: a face that is turned farther from the ray shows no size
UNLIKE = 0.006  # metres a landmark: no face is that far from the mean one
ROUNDS, TURNS = 8, 4  # of the perspective, and of the rotation in each


@dataclass(frozen=True)
class Faces:
    """Of each frame, NaN where no face is seen.

    Attributes:
        noses: depths, metres, if the face is of the mean size. eyes: distance of the outer corners
            of a face that looks at the camera, pixels.
    """

    noses: Float[Tensor, " F"]
    eyes: Float[Tensor, " F"]


def faces_of(image: Float[Tensor, "F 33 3"], K: Float[Tensor, "F 3 3"]) -> Faces:
    """From landmarks in the image and their visibility.

    Scaled orthography with the perspective of the last round (POSIT, DeMenthon and Davis 1995),
    each by Gauss and Newton on rotation and scale.
    """
    places = {0: NOSE}
    for (left, right), (x, y, z) in SIDES.items():
        places |= {left: (x, y, z), right: (-x, y, z)}
    marks = list(places)
    model = image.new_tensor(list(places.values()), dtype=torch.float64)
    model = model - model.mean(0)
    seen = image[:, marks].double()
    known = torch.isfinite(seen).all(-1).all(-1) & (seen[..., 2] > VISIBLE).all(-1)
    rays = pinhole_rays(K.double()[:, None], seen[..., :2].nan_to_num())
    turn = torch.diag(model.new_tensor([1.0, -1.0, -1.0])).repeat(len(rays), 1, 1)
    away = torch.ones_like(rays[..., 0])
    for _ in range(ROUNDS):
        about = rays * away[..., None]
        about = about - about.mean(1, keepdim=True)
        for _ in range(TURNS):
            turn, scale, off = _nearer(about, model, turn)
        away = 1 + (model @ turn.mT)[..., 2] * scale[:, None]
    depth = 1 / scale.clamp_min(1e-6)
    faced = turn[:, 2, 2] < -TURNED
    good = known & faced & (scale > 0) & (off * depth < UNLIKE)
    noses = depth + (turn[:, 2] * model[0]).sum(-1)
    eyes = 2 * SIDES[EYES][0] * K[:, 0, 0].double() / depth
    return Faces(_where(good, noses), _where(good, eyes))


def _nearer(
    about: Float[Tensor, "F L 2"], model: Float[Tensor, "L 3"], turn: Float[Tensor, "F 3 3"]
) -> tuple[Float[Tensor, "F 3 3"], Float[Tensor, " F"], Float[Tensor, " F"]]:
    """A step of the rotation, the scale, and root mean square of the residuals before it."""
    at = model @ turn.mT
    flat = at[..., :2]
    scale = (about * flat).sum((1, 2)) / flat.square().sum((1, 2))
    off = about - scale[:, None, None] * flat
    x, y, z = (at * scale[:, None, None]).unbind(-1)
    none = torch.zeros_like(x)
    rows = torch.stack((none, z, -y, x, -z, none, x, y), -1).unflatten(-1, (2, 4)).flatten(1, 2)
    squares = rows.mT @ rows + 1e-9 * torch.eye(4).to(rows)
    step = torch.linalg.solve(squares, (rows.mT @ off.flatten(1)[..., None]))[:, :3, 0]
    return (
        axis_angle_to_matrices(step) @ turn, scale, off.square().sum(-1).mean(-1).sqrt(),
    )  # fmt: skip


def _where(good: Bool[Tensor, " F"], values: Float[Tensor, " F"]) -> Float[Tensor, " F"]:
    return torch.where(good, values, torch.nan)


# What the sizes of body and face say together.


BODIES = 0.065  # standard deviation of the logarithm of adults' size, 0.054 (Gordon et al. 2014),
# and of what landmarks make of it
FACES = 0.045  # of the same of faces, 0.035, and of what landmarks make of it
# pixels between the outer corners of eyes in which nothing is left to measure; the error falls with
# the square of their distance. Of seven films of faces of 13 to 18 pixels, the size was off by 24 %
# (root mean square), on three of 60 to 70 by 6 %: fourviews as filmed and at a quarter of its
# width, and five built-in clips, whose drawn faces mislead the networks besides.
GUESSED = 7.0
FEWEST = 5  # frames with a face
ODD = 2.5  # standard deviations: a face that says more is one whose landmarks are wrong


@dataclass(frozen=True)
class Size:
    """Of a body, in parts of the body model's mean: its most probable value, and the standard
    deviation of its logarithm.

    Attributes:
        source: what it is known by, for the report.
    """

    mean: float = 1.0
    spread: float = BODIES
    source: str = "taken for the mean of adults"

    @staticmethod
    def by_face(size: float, depths: Float[Tensor, " F"], faces: Faces) -> Size:
        """With that of the face, which alone would put the nose elsewhere than the body does.

        Args:
            size: of the fitted body. depths: of its nose, metres.
        """
        known = torch.isfinite(faces.noses) & (depths > 0)
        if int(known.sum()) < FEWEST:
            return Size()
        shown = size * float((faces.noses / depths)[known].median())
        face = FACES**2 + (GUESSED / float(faces.eyes[known].median())) ** 4
        if math.log(max(shown, 1e-3)) ** 2 > ODD**2 * (BODIES**2 + face):
            return Size()
        share = BODIES**2 / (BODIES**2 + face)
        mean = round(math.exp(share * math.log(shown)), 4)
        return Size(mean, BODIES * math.sqrt(1 - share), "by the face and the mean of adults")
