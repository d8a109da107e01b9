"""The part of a scene that people and objects hide in every training frame.

Nothing says what is there, and the little that shines through whatever is in front of it pulls its
Gaussians about by full steps of Adam, however weak the pull: from the side they are stripes of all
colours. Here they become an opaque surface with the colours of the scene around, and are not
trained on: whoever is in front of them has to explain the images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from hoigs.core.maths.nearest import nearest
from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.model.entity import FIELDS, Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.gaussians import SH_C0
from hoigs.training.unseen.neighbours import NEIGHBOURS, spread

HIDDEN, SHOWN = 0.05, 0.15  # shares of the weight without anything in front; 0 and 1 of it kept
MOST = 20_000  # Gaussians whose colours are solved for together; others take their neighbour's
OPAQUE = 0.9
SPACING = 3  # neighbours whose mean distance is the size, as at the start of a training (3DGS)
REACH = 2  # standard deviations at which a Gaussian still counts in a picture
FAINT = 1e-3  # of a common weight: less is in no picture, or behind the scene itself


@torch.no_grad()
def fill_hidden(
    scene: Entity,
    shown: Float[Tensor, " N"],
    alone: Float[Tensor, " N"],
    centers: Sequence[Float[Tensor, " 3"]],
    shapes: bool = True,
) -> Float[Tensor, " N"] | None:
    """Fill in, in place, what is hidden in all pictures though it would be in some.

    Args:
        shown: blending weights over the training frames. alone: those without people and objects.
        centers: of the cameras, from which colours are meant. shapes: also opacity and size, but at
            the rim; else colours alone.

    Returns:
        How much of each Gaussian is kept, in [0, 1]; None where all of it is.
    """
    if not (alone > 0).any():
        return None
    pictured = alone > FAINT * torch.quantile(alone[alone > 0][:: max(1, len(alone) // 10**6)], 0.9)
    share = (shown / alone.clamp_min(1e-12) - HIDDEN).div(SHOWN - HIDDEN).clamp(0, 1)
    kept = torch.where(pictured, share.square() * (3 - 2 * share), 1.0)
    hidden = (kept < 1).nonzero()[:, 0]
    known = pictured & (kept == 1)
    if not len(hidden) or not known.any():
        return None
    gaussians = scene.canonical
    target = {"sh": torch.zeros_like(gaussians.sh[hidden])}
    target["sh"][:, 0] = _colors(scene, hidden, known, kept, centers)
    if shapes:
        beside, apart = nearest(gaussians.means[hidden], NEIGHBOURS + 1, gaussians.means)
        within = (kept[beside] < 1).all(1)  # at the rim they reach into what is seen
        size = apart[:, 1 : SPACING + 1].mean(1)
        size = size.minimum(room(gaussians.means[hidden], gaussians.means[known], centers))
        size = size.clamp_min(1e-6).log()[:, None].to(gaussians.log_scales).expand(-1, 3)
        target["log_scales"] = torch.where(within[:, None], size, gaussians.log_scales[hidden])
        logits = gaussians.opacity_logits[hidden]
        target["opacity_logits"] = torch.where(within, _logit(OPAQUE), logits)
    for name, value in target.items():
        parameter = scene.get_parameter(name)
        if parameter.requires_grad:
            weight = (1 - kept[hidden]).reshape(-1, *[1] * (value.ndim - 1))
            parameter[hidden] += weight * (value - parameter[hidden])
    return kept


def spare_hidden(model: SceneModel, kept: Mapping[str, Float[Tensor, " N"]]) -> None:
    """Scale the gradients of Gaussians by how much of them is kept, by entity.

    Where density control has changed the number of an entity's Gaussians since, they stay.
    """
    for name, share in kept.items():
        entity = model.entity(name)
        if len(entity) != len(share):
            continue
        for field in FIELDS:
            gradient = entity.get_parameter(field).grad
            if gradient is not None:
                gradient.mul_(share.reshape(-1, *[1] * (gradient.ndim - 1)))


def _colors(
    scene: Entity,
    hidden: Int[Tensor, " H"],
    known: Bool[Tensor, " N"],
    kept: Float[Tensor, " N"],
    centers: Sequence[Float[Tensor, " 3"]],
) -> Float[Tensor, "H 3"]:
    """Coefficients of degree 0 of the hidden Gaussians, continued from the known ones beside."""
    means = scene.canonical.means
    solved = hidden[:: max(1, math.ceil(len(hidden) / MOST))]
    around = known.nonzero()[:, 0]
    beside = around[nearest(means[solved], NEIGHBOURS, means[around])[0].unique()]
    rows = torch.cat((solved, beside))
    seen_as = mean_colors(scene.canonical.sh[rows], means[rows], centers)
    values = spread((seen_as - 0.5) / SH_C0, kept[rows], means[rows])[: len(solved)]
    if len(solved) == len(hidden):
        return values
    return values[nearest(means[hidden], 1, means[solved])[0][:, 0]]


def room(
    points: Float[Tensor, "H 3"],
    seen: Float[Tensor, "N 3"],
    centers: Sequence[Float[Tensor, " 3"]],
) -> Float[Tensor, " H"]:
    """How large a Gaussian at each point may be to stay off the others in the picture of every
    camera: a standard deviation, metres, in float64.

    Points are apart in depth, too: the distance to a neighbour in space says nothing of it.
    """
    most = torch.full((len(points),), torch.inf, dtype=torch.float64, device=points.device)
    for center in torch.stack([c.to(points) for c in centers]).unique(dim=0):
        rays, others = points - center, normalize(seen - center, dim=-1)
        distance = rays.norm(dim=-1, keepdim=True)
        angle = nearest(normalize(rays, dim=-1), 1, others)[1]
        most = most.minimum((angle * distance)[:, 0] / REACH)
    return most


def _logit(share: float) -> float:
    return math.log(share / (1 - share))
