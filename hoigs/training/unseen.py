"""Sides of people and objects that no training frame shows, and the scene that these hide.

A Gaussian there has no image to follow. The few pixels in which it shines through, at outlines and
through half-transparent neighbours, make it a spike or a blotch of somebody else's colour. Here it
takes its values from the Gaussians beside it on the surface that were seen, and from its mirror
image on a body: the solution of a screened Laplace equation over the graph of neighbours (as in
gradient-domain inpainting, Perez et al. 2003), which keeps what was seen. Patterns do not continue
that way: far from all that was seen, stripes become their mean. So a person's back may take the
colours of the front at the same height, as avatars from one picture do (e.g. Natsume et al. 2019,
SiCloPe), and the hidden part of a scene those of the clip's own points there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from hoigs.core.interfaces.body import HEAD_PART
from hoigs.core.interfaces.deformation import ProvidesTemplate, Template
from hoigs.core.maths.nearest import nearest
from hoigs.core.maths.projection import project
from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import TrainSpec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import FIELDS, SH_C0, Gaussians

# Values of points that were seen, continued over those that were not.

NEIGHBOURS = 8
OPPOSITE = 8.0  # weight of the opposite side's colours; that of all neighbours together is about 1
OPPOSITES = 4  # points there whose mean is taken: colours of single Gaussians are noisy
ASIDE = 0.03  # metres by which a point and its opposite may be apart across the line of sight


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


# The part of a scene that people and objects hide in every training frame.
#
# No pixel constrains its Gaussians except through half-transparent people and objects in front, and
# Adam takes full steps however small such a gradient is: seen from the side, these Gaussians become
# stripes of arbitrary colours. Here they become an opaque surface in the colours of the clip's
# points, or of the scene around, and get no gradients, so that people and objects explain the
# images.

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
    points: tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]] | None = None,
) -> Float[Tensor, " N"] | None:
    """Fill in, in place, what is hidden in all pictures though it would be in some.

    Args:
        shown: blending weights over the training frames. alone: those without people and objects.
        centers: of the cameras, from which colours are meant. shapes: also opacity and size, but at
            the rim; else colours alone.
        points: in the world, metres, and their RGB in [0, 1], of which the nearest colour each; by
            default colours are continued from the Gaussians beside.

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
    if points is None:
        target["sh"][:, 0] = _colors(scene, hidden, known, kept, centers)
    else:
        places, colors = (p.to(gaussians.means) for p in points)
        beside = nearest(gaussians.means[hidden], 1, places)[0][:, 0]
        target["sh"][:, 0] = (colors[beside] - 0.5) / SH_C0
    if shapes:
        beside, apart = nearest(gaussians.means[hidden], NEIGHBOURS + 1, gaussians.means)
        within = (kept[beside] < 1).all(1)  # at the rim they reach into what is seen
        size = apart[:, 1 : SPACING + 1].mean(1)
        size = size.minimum(room(gaussians.means[hidden], gaussians.means[known], centers))
        size = size.clamp_min(1e-6).log()[:, None].to(gaussians.log_scales).expand(-1, 3)
        target["log_scales"] = torch.where(within[:, None], size, gaussians.log_scales[hidden])
        logit, logits = math.log(OPAQUE / (1 - OPAQUE)), gaussians.opacity_logits[hidden]
        target["opacity_logits"] = torch.where(within, logit, logits)
    _blend(scene, gaussians[hidden], target, 1 - kept[hidden], hidden)
    return kept


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


# How much of each Gaussian the training frames show.

FRAMES = 16  # training frames in which weights are summed
FAINTEST = -4.0  # opacity logit, of 2 %
HALF_SEEN = 0.1  # half is known at this part of a well seen Gaussian's weight, or of its share
WELL_SEEN = 0.9  # quantile, among Gaussians with any weight, of a well seen one


def training_frames(clip: Clip) -> Sequence[int]:
    """Positions of some training frames, evenly spread."""
    positions = clip.split["train"]
    return positions[:: max(1, math.ceil(len(positions) / FRAMES))]


def seen_weights(
    model: SceneModel, clip: Clip
) -> dict[str, tuple[Float[Tensor, " N"], Float[Tensor, " N"]]]:
    """Blending weights of each entity's Gaussians, summed over pixels and training frames: as they
    are, and as they would be with nothing before them, but of a scene without people and objects.

    Gaussians of people and objects are drawn with FAINTEST opacity at least: a transparent one with
    nothing before it is seen as well, to be transparent.
    """
    scenes, names = model.names("scene"), (*model.names("human"), *model.names("object"))
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for position in training_frames(clip):
        frame = clip[position]
        moment, camera = frame.moment.to(model.device), frame.camera.to(model.device)
        with torch.no_grad():
            state = model(moment)
        drawn, rows = state.joined().detach(), state.slices()
        logits = drawn.opacity_logits.clone()
        for name in names:
            logits[rows[name]] = logits[rows[name]].clamp_min(FAINTEST)
        drawn = drawn.replace(opacity_logits=logits)
        shown = blending_weights(model, drawn, camera)
        alone = {name: footprints(model, drawn[rows[name]], camera) for name in names}
        for name in scenes:
            alone[name] = blending_weights(model, drawn[rows[name]], camera)
        for name in (*names, *scenes):
            known = sums.get(name, (0.0, 0.0))
            sums[name] = (known[0] + shown[rows[name]], known[1] + alone[name])
    return sums


@torch.no_grad()
def footprints(model: SceneModel, drawn: Gaussians, camera: Camera) -> Float[Tensor, " N"]:
    """The weight of each Gaussian with nothing before it: the integral of its opacity over the
    screen, square pixels; 0 where its centre is not in the picture."""
    camera = camera.to(drawn.means.dtype)
    shown = project(
        drawn.means, drawn.quats, drawn.log_scales, drawn.opacity_logits,
        camera.world_to_camera, camera.K, camera.width, camera.height,
        low_pass=model.low_pass, antialiased=model.antialiased,
    )  # fmt: skip
    size = shown.means2d.new_tensor([camera.width, camera.height])
    within = ((shown.means2d >= 0) & (shown.means2d <= size)).all(-1)
    xx, xy, yy = shown.covs.unbind(-1)
    areas = 2 * math.pi * shown.opacities * (xx * yy - xy * xy).clamp_min(0).sqrt()
    return areas.new_zeros(len(drawn)).index_copy(0, shown.index, areas * within)


def blending_weights(model: SceneModel, drawn: Gaussians, camera: Camera) -> Float[Tensor, " N"]:
    """Blending weights of the Gaussians, summed over the pixels.

    The derivative of a colour by its degree-0 coefficient is the weight times Y_00.
    """
    sh = torch.zeros(len(drawn), 1, 3, device=model.device, requires_grad=True)
    with torch.enable_grad():
        color = model.rasterize(drawn.replace(sh=sh), camera).color
        (gradient,) = torch.autograd.grad(color[..., 0].sum(), sh)
    return gradient[:, 0, 0] / SH_C0


def confidence(
    shown: Float[Tensor, " N"], alone: Float[Tensor, " N"]
) -> Float[Tensor, " N"] | None:
    """How well the training frames show each Gaussian, in [0, 1); None if none was seen at all.

    One is known from many pixels, or, if it is small or transparent, from a share of its few.

    Args:
        shown, alone: as `seen_weights` of one entity.
    """
    if not (shown > 0).any():
        return None
    share = torch.where(alone > 0, shown / alone.clamp_min(1e-12), 0.0)
    return 1 - (1 - _saturated(shown)) * (1 - _saturated(share))


def _saturated(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """x^2 / (x^2 + h^2): 1/2 at HALF_SEEN of what is common."""
    known = values[values > 0]
    if not len(known):
        return torch.zeros_like(values)
    half = HALF_SEEN * torch.quantile(known, WELL_SEEN)
    return values.square() / (values.square() + half.square())


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
        Of each scene that hides in part, how much of its Gaussians is kept (see `Filling.spare`).
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
    points = (clip.points, clip.point_colors) if len(clip.points) else None
    kept = {}
    for name in model.names("scene") if scenes else ():
        share = fill_hidden(model.entity(name), *weights[name], centers, shapes, points)
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
    entity: Entity,
    drawn: Gaussians,
    target: dict[str, Tensor],
    share: Float[Tensor, " M"],
    rows: slice | Int[Tensor, " M"] = slice(None),
) -> None:
    """Move fields that are trained from `drawn` towards `target`, in place, by a share.

    Args:
        rows: of the entity, that all others belong to.
    """
    for name, value in target.items():
        parameter = entity.get_parameter(name)
        if parameter.requires_grad:
            weight = share.reshape(-1, *[1] * (value.ndim - 1))
            parameter[rows] += weight * (value - getattr(drawn, name))


# When, in a training, what no frame shows is filled in.


class Filling:
    """Fills in people and objects after shares of their own steps, and scenes after shares of all.

    Args:
        settled: step after which people and objects no longer change.

    Attributes:
        hidden: of each scene that hides in part, how much of its Gaussians is kept.
    """

    def __init__(self, spec: TrainSpec, settled: int) -> None:
        self.opposite = spec.unseen_sides == "opposite"
        self.settled, self.steps = settled, spec.steps
        self._own, self._scenes = (
            {max(1, round(share * steps)) for share in spec.fill_unseen}
            for steps in (settled, spec.steps)
        )
        self.hidden: dict[str, Float[Tensor, " N"]] = {}

    def spare(self, model: SceneModel) -> None:
        """Scale the gradients of Gaussians by how much of them is kept, before a step of the
        optimizer.

        Where density control has changed the number of an entity's Gaussians since, they stay.
        """
        for name, kept in self.hidden.items():
            entity = model.entity(name)
            if len(entity) != len(kept):
                continue
            for field in FIELDS:
                gradient = entity.get_parameter(field).grad
                if gradient is not None:
                    gradient.mul_(kept.reshape(-1, *[1] * (gradient.ndim - 1)))

    def after(self, step: int, model: SceneModel, clip: Clip) -> None:
        """Fill in what is due after a step."""
        own, scenes = step in self._own, step in self._scenes
        if not own and not scenes:
            return
        shapes = step < (self.settled if own else self.steps)
        found = fill_unseen(
            model, clip, shapes=shapes, opposite=self.opposite, own=own, scenes=scenes
        )
        if scenes:
            self.hidden = found
