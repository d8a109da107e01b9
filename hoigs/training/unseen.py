"""Sides of people and objects that no training frame shows.

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

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hoigs.core.interfaces.body import HEAD_PART
from hoigs.core.interfaces.deformation import ProvidesTemplate, Template
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.nearest import nearest
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import SH_C0, Gaussians

FRAMES = 16  # training frames in which weights are summed
NEIGHBOURS = 8
HALF_SEEN = 0.1  # confidence is 1/2 at this share of a well seen Gaussian's weight
WELL_SEEN = 0.9  # quantile, among Gaussians with any weight, of a well seen one
OPPOSITE = 8.0  # weight of the opposite side's colours; that of all neighbours together is about 1
OPPOSITES = 4  # points there whose mean is taken: colours of single Gaussians are noisy
ASIDE = 0.03  # metres by which a point and its opposite may be apart across the line of sight


def fill_unseen(
    model: SceneModel, clip: Clip, *, shapes: bool = True, opposite: bool = False
) -> None:
    """Fill in, in place, the Gaussians of people and objects by how little was seen of them.

    Args:
        opposite: people take patterns from the opposite side of their body (`opposite_points`).
        shapes: also opacity, size and, on a body's template, the distance from its surface; else
            colours alone.
    """
    training = model.training
    model.eval()
    weights = seen_weights(model, clip)
    for name in (*model.names("human"), *model.names("object")):
        seen = confidence(*weights[name])
        if seen is not None:
            _fill(model.entity(name), seen, shapes, opposite)
    model.train(training)


def seen_weights(
    model: SceneModel, clip: Clip, frames: int = FRAMES
) -> dict[str, tuple[Float[Tensor, " N"], Float[Tensor, " N"]]]:
    """Blending weights of each entity's Gaussians, summed over pixels and training frames, inside
    the entity's mask and outside it."""
    positions = clip.split["train"]
    names = (*model.names("human"), *model.names("object"))
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for position in positions[:: max(1, math.ceil(len(positions) / frames))]:
        frame = clip[position]
        moment, camera = frame.moment.to(model.device), frame.camera.to(model.device)
        with torch.no_grad():
            state = model(moment)
        everywhere = torch.ones(camera.height, camera.width, device=model.device)
        masks = [(frame.masks[n] > 0).to(everywhere) if n in frame.masks else everywhere
                 for n in names]  # fmt: skip
        total, *within = _weights(model, state.joined().detach(), camera, [everywhere, *masks])
        for name, inside in zip(names, within, strict=True):
            rows = state.slices()[name]
            known = sums.get(name, (0.0, 0.0))
            sums[name] = (known[0] + inside[rows], known[1] + (total - inside)[rows])
    return sums


def _weights(
    model: SceneModel, drawn: Gaussians, camera: Camera, maps: Sequence[Float[Tensor, "H W"]]
) -> list[Float[Tensor, " N"]]:
    """Blending weights of the Gaussians, summed over the pixels, which each of `maps` weighs.

    The derivative of a colour by its degree-0 coefficient is the weight times Y_00, and the three
    channels have coefficients of their own: one backward gives the weights of three maps.
    """
    sh = torch.zeros(len(drawn), 1, 3, device=model.device, requires_grad=True)
    found: list[Tensor] = []
    with torch.enable_grad():
        color = model.rasterizer.render(drawn.replace(sh=sh), camera, RenderRequest()).color
        for at in range(0, len(maps), 3):
            some = torch.stack(list(maps[at : at + 3]), -1)
            total = (color[..., : some.shape[-1]] * some).sum()
            (gradient,) = torch.autograd.grad(total, sh, retain_graph=True)
            found += (gradient[:, 0, : some.shape[-1]] / SH_C0).unbind(-1)
    return found


def confidence(
    inside: Float[Tensor, " N"], outside: Float[Tensor, " N"]
) -> Float[Tensor, " N"] | None:
    """How well each Gaussian was seen, in [0, 1); None if none was seen at all.

    Weight outside the mask counts against it: its colour is then somebody else's.
    """
    weight = (inside - outside).clamp_min(0)
    if not (weight > 0).any():
        return None
    half = HALF_SEEN * torch.quantile(weight[weight > 0], WELL_SEEN)
    return weight.square() / (weight.square() + half.square())


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


def opposite_points(template: Template) -> Int[Tensor, "N k"]:
    """Indices of points on the other side of the body, front or back, -1 where there are none.

    These are the nearest ones of the same part, seen along z, whose normals point the other way.
    Bodies face +z in their zero pose, their limbs lie across it. The head has none: hair is not a
    face.
    """
    found = torch.full_like(template.parts, -1)[:, None].repeat(1, OPPOSITES)
    flat = template.points * template.points.new_tensor([1, 1, 0])
    front = template.normals[:, 2] > 0
    for part in template.parts.unique().tolist():
        for side in (True, False):
            own = ((template.parts == part) & (front == side)).nonzero()[:, 0]
            others = ((template.parts == part) & (front != side)).nonzero()[:, 0]
            if part == HEAD_PART or not len(own) or len(others) < OPPOSITES:
                continue
            index, apart = nearest(flat[own], OPPOSITES, flat[others])
            close = apart[:, -1] < ASIDE
            found[own[close]] = others[index][close]
    return found


def spread(
    values: Float[Tensor, "N D"],
    seen: Float[Tensor, " N"],
    points: Float[Tensor, "N 3"],
    mirror: Tensor | None = None,
    opposite: Int[Tensor, "N k"] | None = None,
) -> Float[Tensor, "N D"]:
    """Values of what was seen, continued smoothly over what was not.

    Minimises sum_i s_i / (1 - s_i) |y_i - x_i|^2 + sum_ij w_ij |y_i - y_j|^2 over the graph that
    joins each point with its nearest neighbours, of weight 1 together, and with its mirror image.
    Where points have opposite ones, OPPOSITE (1 - s_i)^4 s' |y_i - x'|^2 is added, with the mean s'
    of their s, and the mean x' of their values, weighed by s.

    Args:
        seen: s, in [0, 1]. mirror: index of each point's mirror image, int64 [N].
        opposite: indices of each point's opposite ones, -1 without any.
    """
    from scipy import sparse  # on use: scipy takes a while to import
    from scipy.sparse.linalg import splu

    count = len(points)
    near = nearest(points, NEIGHBOURS)[0].cpu().numpy()
    ends, degree = near.ravel(), near.shape[1]
    starts = np.repeat(np.arange(count), degree)
    weights = np.full(len(ends), 1 / max(1, degree))
    if mirror is not None:
        ends = np.concatenate((ends, mirror.cpu().numpy()))
        starts = np.concatenate((starts, np.arange(count)))
        weights = np.concatenate((weights, np.ones(count)))
    graph = sparse.coo_matrix((weights, (starts, ends)), (count, count)).tocsr()
    graph = (graph + graph.T) / 2
    laplacian = sparse.diags(np.asarray(graph.sum(1)).ravel()) - graph
    s = seen.double().cpu().numpy()
    data = s / (1.0001 - s) + 1e-6  # what is cut off from all that was seen stays
    given = values.double().cpu().numpy()
    known = data[:, None] * given
    if opposite is not None:
        others = opposite.cpu().numpy()
        shares = np.where(others >= 0, s[others], 0.0)
        weight = OPPOSITE * (1 - s) ** 4 * shares.mean(1)
        means = (shares[..., None] * given[others]).sum(1) / (shares.sum(1)[:, None] + 1e-9)
        data, known = data + weight, known + weight[:, None] * means
    found = splu((sparse.diags(data) + laplacian).tocsc()).solve(known)
    return torch.from_numpy(found).to(values)
