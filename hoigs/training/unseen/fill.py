"""Sides of people and objects that no training frame shows, and the scene that these hide.

A Gaussian there has no image to follow. The few pixels in which it shines through, at outlines and
through half-transparent neighbours, make it a spike or a blotch of somebody else's colour. Here it
takes its values from the Gaussians beside it on the surface that were seen, and from its mirror
image on a body: the solution of a screened Laplace equation over the graph of neighbours (as in
gradient-domain inpainting, Perez et al. 2003), which keeps what was seen. Patterns do not continue
that way: far from all that was seen, stripes become their mean. So a person's back may take the
colours of the front at the same height, as avatars from one picture do (e.g. Natsume et al. 2019,
SiCloPe).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.interfaces.deformation import ProvidesTemplate
from hoigs.core.maths.nearest import nearest
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.training.unseen.hidden_scene import fill_hidden
from hoigs.training.unseen.neighbours import opposite_points, spread
from hoigs.training.unseen.weights import confidence, seen_weights, training_frames


def fill_unseen(
    model: SceneModel,
    clip: Clip,
    *,
    shapes: bool = True,
    opposite: bool = False,
    own: bool = True,
    scenes: bool = True,
) -> dict[str, Float[Tensor, " N"]]:
    """Fill in, in place, Gaussians by how little the training frames show of them.

    Args:
        opposite: people take patterns from the opposite side of their body (`opposite_points`).
        shapes: also opacity, size and, on a body's template, the distance from its surface; else
            colours alone.
        own, scenes: fill people and objects, and scenes.

    Returns:
        Of each scene that hides in part, how much of its Gaussians is kept (see `spare_hidden`).
    """
    entities = (*model.names("human"), *model.names("object"))
    if not entities:
        return {}
    training = model.training
    model.eval()
    weights = seen_weights(model, clip)
    for name in entities if own else ():
        seen = confidence(*weights[name])
        if seen is not None:
            _fill(model.entity(name), seen, shapes, opposite)
    centers = [clip.cameras[p].center for p in training_frames(clip)]
    kept = {}
    for name in model.names("scene") if scenes else ():
        share = fill_hidden(model.entity(name), *weights[name], centers, shapes)
        if share is not None:
            kept[name] = share
    model.train(training)
    return kept


@torch.no_grad()
def _fill(entity: Entity, seen: Float[Tensor, " N"], shapes: bool, opposite: bool) -> None:
    deformation, canonical = entity.deformation, entity.canonical
    other = None
    if isinstance(deformation, ProvidesTemplate):
        template = deformation.template(canonical)
        drawn, points, normals = template.gaussians, template.points, template.normals
        mirror = nearest(template.mirrored, 1, points)[0][:, 0]
        height = ((drawn.means - points) * normals).sum(-1, keepdim=True)
        other = opposite_points(template) if opposite else None
    else:
        drawn, points, mirror = canonical, canonical.means, None
        height = torch.zeros_like(points[:, :1])
    size = drawn.log_scales.mean(-1, keepdim=True)
    known = torch.cat((drawn.sh[:, 0], drawn.opacity_logits[:, None], size, height), -1)
    color, logit, size, height = spread(known, seen, points, mirror).split((3, 1, 1, 1), -1)
    if other is not None:
        color = spread(drawn.sh[:, 0], seen, points, mirror, other)
    sh = torch.zeros_like(drawn.sh)
    sh[:, 0] = color
    target = {"sh": sh}
    if shapes:
        target |= {"opacity_logits": logit[:, 0], "log_scales": size.expand(-1, 3)}
        if mirror is not None:
            target["means"] = points + height * normals
    _blend(entity, drawn, target, 1 - seen)


def _blend(
    entity: Entity, drawn: Gaussians, target: dict[str, Tensor], share: Float[Tensor, " N"]
) -> None:
    """Move fields that are trained from `drawn` towards `target`, in place."""
    for name, value in target.items():
        parameter, now = entity.get_parameter(name), getattr(drawn, name)
        if parameter.requires_grad:
            parameter.add_(share.reshape(-1, *[1] * (value.ndim - 1)) * (value - now))
