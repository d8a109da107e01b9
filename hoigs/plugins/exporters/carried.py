"""Gaussians over time as still ones that joints carry, and a few modes of what joints leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from hoigs.core.interfaces.deformation import ProvidesTemplate
from hoigs.core.maths.rotations import (
    conjugate_quats,
    matrices_to_quats,
    multiply_quats,
    normalize_quats,
)
from hoigs.core.maths.skinning import ancestor_table, joint_transforms, joint_turns
from hoigs.core.maths.spherical_harmonics import mean_colors
from hoigs.core.model.exporter import ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.plugins.exporters.posed import (
    BodyMotion,
    Move,
    ObjectMotion,
    body_motion,
    eyes_of,
    object_motion,
    world_move,
)

INFLUENCES = 4  # joints that may carry a Gaussian, as many as one set of glTF's has
NEAR = 6  # moments at which Gaussians are compared with the body, spread over all
STILL_M = 5e-4  # Gaussians that all stay within this are stored once
VISIBLE = 2 / 255  # root mean square change of colour, or what shows as much, that needs no mode
STEADY = 0.02  # change of colour, opacity and logarithm of sizes of what is stored once
PARTS = {"means": 3, "quats": 4, "log_scales": 3, "opacity": 1, "color": 3}
FLOORS = {"means": 2e-4, "quats": 4e-3, "log_scales": 1e-2, "opacity": 2e-3, "color": 2e-3}


@dataclass(frozen=True)
class Joints:
    """What may carry an entity: J joints over F moments, in the world of the file.

    Attributes:
        transforms: rest pose to world.
        turns: their unit quaternions, of signs that may be averaged.
    """

    transforms: Float[Tensor, "F J 4 4"]
    turns: Float[Tensor, "F J 4"]


@dataclass(frozen=True)
class Carried:
    """One entity over F moments: N Gaussians, carried by joints and changed by K modes.

        x(t) = sum_j w_j T_j(t) (p + sum_k c_k(t) m_k)

    and in the same way rotations (the mean quaternion of the joints times q + sum_k c_k m_k,
    normalised), logarithms of sizes, opacities and colours, which joints leave as they are.

    Attributes:
        gaussians: without modes, where the joints are at rest; raw, with all SH bands if the entity
            is still.
        joints, weights: of each Gaussian; an entity that is not a person has one joint.
        modes: by part (`PARTS`), displacements. coefficients: c_k at the moments, in [-1, 1].
        left_mm: root mean square distance of the means from the run's, millimetres.
        left_color: the same of colours, in [0, 1].
        still: whether nothing changes over time.
    """

    name: str
    gaussians: Gaussians
    joints: Int[Tensor, "N 4"]
    weights: Float[Tensor, "N 4"]
    modes: dict[str, Float[Tensor, "K N d"]]
    coefficients: Float[Tensor, "F K"]
    left_mm: float
    left_color: float
    still: bool = False

    def __len__(self) -> int:
        return len(self.gaussians)

    def only(self, rows: Tensor) -> Carried:
        """These Gaussians."""
        return replace(
            self, gaussians=self.gaussians[rows], joints=self.joints[rows],
            weights=self.weights[rows], modes={k: m[:, rows] for k, m in self.modes.items()},
        )  # fmt: skip

    def importance(self) -> Float[Tensor, " N"]:
        """Opacity times the area of the two longest axes, square metres."""
        two = self.gaussians.log_scales.sort(-1).values[:, 1:].sum(-1)
        return self.gaussians.opacities * two.exp()


def still(name: str, gaussians: Gaussians) -> Carried:
    """An entity that does not move."""
    none = torch.zeros(len(gaussians), INFLUENCES)
    return Carried(name, gaussians, none.long(), none, {}, torch.zeros(1, 0), 0.0, 0.0, still=True)


def same(a: Gaussians, b: Gaussians) -> bool:
    """Whether Gaussians stay where and as they are."""
    pairs = ((a.means, b.means, STILL_M), (a.sh, b.sh, STEADY), (a.opacities, b.opacities, STEADY),
             (a.log_scales, b.log_scales, STEADY))  # fmt: skip
    return not len(a) or all(float((x - y).abs().max()) < limit for x, y, limit in pairs)


def body_joints(motion: BodyMotion) -> Joints:
    """The joints of a person, scaled about the pelvis as the Gaussians are drawn."""
    parents = motion.body.parents
    moved = joint_transforms(motion.rotations, motion.rest_joints, parents, motion.transl)
    pelvis = motion.pelvis[:, None]
    grown = motion.scale * moved
    grown[..., :3, 3] += (1 - motion.scale) * pelvis
    grown[..., 3, 3] = 1
    table = ancestor_table(parents)
    return Joints(grown, torch.stack([joint_turns(m, parents, table) for m in moved]))


def rigid_joint(motion: ObjectMotion) -> Joints:
    """The one joint of an object."""
    transforms = torch.eye(4).repeat(len(motion.translations), 1, 1)
    transforms[:, :3, :3], transforms[:, :3, 3] = motion.rotations, motion.translations
    turns = matrices_to_quats(motion.rotations)
    return Joints(transforms[:, None], turns[:, None])


def body_weights(
    request: ExportRequest, motion: BodyMotion, means: Float[Tensor, "F N 3"]
) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
    """Which joints carry each Gaussian: as the model has it, or where it tells nothing, those of
    the vertex that stays nearest to it over time."""
    entity, own = request.scene.entity(motion.name), None
    if isinstance(entity.deformation, ProvidesTemplate):
        own = entity.deformation.template(entity.canonical).weights
    if own is None:
        own = _nearest_weights(motion, means)
    found = own.detach().cpu().float().topk(INFLUENCES, dim=1)
    return found.indices, quantised(found.values / found.values.sum(1, keepdim=True)) / 65535


def _nearest_weights(motion: BodyMotion, means: Float[Tensor, "F N 3"]) -> Float[Tensor, "N J"]:
    some = np.unique(np.linspace(0, len(means) - 1, NEAR).round().astype(int)).tolist()
    vertices = torch.cat([motion.vertices(i) for i in some], -1)
    near = cKDTree(vertices.numpy()).query(torch.cat([means[i] for i in some], -1).numpy())[1]
    return motion.body.skinning_weights[torch.from_numpy(near)]


def quantised(weights: Float[Tensor, "N k"]) -> Float[Tensor, "N k"]:
    """Whole numbers that sum to 65535, as glTF demands of weights of 16 bits."""
    codes = (weights * 65535).round()
    rows = torch.arange(len(codes))
    codes[rows, codes.argmax(1)] += 65535 - codes.sum(1)
    return codes


def _blended(
    joints: Joints, chosen: Int[Tensor, "N 4"], weights: Float[Tensor, "N 4"]
) -> tuple[Float[Tensor, "F N 3 4"], Float[Tensor, "F N 4"]]:
    """The transform and the turn by which each Gaussian is carried at each moment."""
    whole = torch.zeros(len(chosen), joints.transforms.shape[1])
    whole.scatter_add_(1, chosen, weights)
    flat = joints.transforms[:, :, :3].flatten(2)
    return (whole @ flat).unflatten(-1, (3, 4)), normalize_quats(whole @ joints.turns)


def _rest(
    means: Float[Tensor, "F N 3"], blended: tuple[Tensor, Tensor]
) -> tuple[Float[Tensor, "F N 3"], Tensor]:
    """Means where the joints are at rest, and the inverse turns."""
    moves, turns = blended
    x, y, z = moves[..., :3].unbind(-1)  # the inverse by hand: as quick as it should be
    across = torch.stack((y.cross(z, dim=-1), z.cross(x, dim=-1), x.cross(y, dim=-1)), -2)
    away = (means - moves[..., 3])[..., None]
    volume = (across[..., 0, :] * x).sum(-1, keepdim=True)
    return (across @ away)[..., 0] / volume, conjugate_quats(turns)


def carried(
    name: str,
    frames: Sequence[Gaussians],
    joints: Joints,
    bound: tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]],
    eyes: Sequence[Float[Tensor, " 3"]],
    most: int,
) -> Carried:
    """An entity that joints carry.

    Args:
        frames: in the world of the file. bound: joints and weights of each Gaussian.
        eyes: camera centres. Colours are the mean of what they see, as bands of SH that turn with
            a skin are in no standard. most: modes at the most.
    """
    means = torch.stack([g.means for g in frames])
    rest, back = _rest(means, _blended(joints, *bound))
    quats = multiply_quats(back, normalize_quats(torch.stack([g.quats for g in frames])))
    quats = quats * torch.where((quats * quats[:1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    colors = torch.stack([mean_colors(g.sh, g.means, eyes) for g in frames])
    scales = torch.stack([g.log_scales for g in frames])
    opacity = torch.stack([g.opacities for g in frames])
    values = {
        "means": rest, "quats": quats, "log_scales": scales, "opacity": opacity[..., None],
        "color": colors,
    }  # fmt: skip
    middle = {k: v.mean(0) for k, v in values.items()}
    weights = _visible(middle)
    coefficients, modes = _modes({k: v - middle[k] for k, v in values.items()}, weights, most)
    off = {
        k: values[k] - middle[k] - torch.einsum("fk,knd->fnd", coefficients, modes[k])
        for k in ("means", "color")
    }
    canonical = Gaussians(
        middle["means"], normalize_quats(middle["quats"]), middle["log_scales"],
        middle["opacity"][:, 0].clamp(1e-6, 1 - 1e-6).logit(),
        ((middle["color"] - 0.5) / SH_C0)[:, None],
    )  # fmt: skip
    left = {k: float(v.square().sum(-1).mean().sqrt()) for k, v in off.items()}
    return Carried(
        name, canonical, *bound, modes, coefficients, 1e3 * left["means"], left["color"]
    )  # fmt: skip


def _visible(middle: dict[str, Tensor]) -> dict[str, Float[Tensor, "N 1"]]:
    """How much a change of each part is seen: opacity times size, and for a displacement its share
    of the size."""
    size = middle["log_scales"].mean(-1, keepdim=True).exp()
    seen = middle["opacity"] * size
    return {
        "means": 0.25 * middle["opacity"], "quats": 0.5 * seen, "log_scales": 0.5 * seen,
        "opacity": size, "color": seen,
    }  # fmt: skip


def _modes(
    changes: dict[str, Float[Tensor, "F N d"]], weights: dict[str, Tensor], most: int
) -> tuple[Float[Tensor, "F K"], dict[str, Tensor]]:
    """The principal components of what changes over time, at most `most`, and no more than make
    what is left as little visible as VISIBLE of colour. Parts that hardly change have none.
    """
    moving = {k: v for k, v in changes.items() if float(v.square().mean()) ** 0.5 > FLOORS[k] / 4}
    count = len(next(iter(changes.values())))
    if not moving or count < 2:
        return torch.zeros(count, 0), {k: v[:0] for k, v in changes.items()}
    rows = torch.cat([(v * weights[k]).flatten(1) for k, v in moving.items()], 1).double()
    power, axes = torch.linalg.eigh(rows @ rows.mT)
    seen = count * weights["color"].double().square().sum()
    left = (power.clamp_min(0).cumsum(0) / seen).sqrt()
    kept = min(most, count - 1, int((left > VISIBLE).sum()))
    axes = axes.flip(-1)[:, :kept].float()
    # signs of eigenvectors are free: the largest entry is positive, on every machine
    axes = axes * axes.gather(0, axes.abs().argmax(0, keepdim=True)).sign()
    peaks = axes.abs().amax(0)
    modes = {
        k: torch.einsum("fk,fnd->knd", axes * peaks, v if k in moving else torch.zeros_like(v))
        for k, v in changes.items()
    }
    return axes / peaks, modes


# Entities of a run.


@dataclass(frozen=True)
class Entity:
    """What is written of one entity. motion: of its joints; None if it is still."""

    carried: Carried
    motion: BodyMotion | ObjectMotion | None


def collect(request: ExportRequest, modes: int, progress: Progress) -> list[Entity]:
    """Every entity that is exported, in the world of the file."""
    move = world_move(request.clip, "y")
    frames: dict[str, list[Gaussians]] = {name: [] for name in request.entities}
    for i, moment in enumerate(request.moments):
        progress(0.5 * i / len(request.moments), f"moment {i + 1} of {len(request.moments)}")
        state = request.scene(moment.to(request.scene.device), request.entities)
        for name, gaussians in state.gaussians.items():
            seen = gaussians.detach().to("cpu", torch.float32)
            seen, known = move.gaussians(seen), frames[name]
            known.append(known[0] if known and same(known[0], seen) else seen)
    eyes = [move.points(eye) for eye in eyes_of(request.clip)]
    made = []
    for i, (name, seen) in enumerate(frames.items()):
        progress(0.5 + 0.4 * i / len(frames), name)
        made.append(_entity(request, name, seen, move, eyes, modes))
        seen.clear()
    return made


def _entity(
    request: ExportRequest, name: str, frames: list[Gaussians], move: Move, eyes: Any, modes: int
) -> Entity:
    if all(g is frames[0] for g in frames):
        return Entity(still(name, frames[0]), None)
    if request.scene.entity(name).kind == "human" and name in request.bodies:
        body = body_motion(request, name).moved(move)
        bound = body_weights(request, body, torch.stack([g.means for g in frames]))
        return Entity(carried(name, frames, body_joints(body), bound, eyes, modes), body)
    rigid = object_motion(request, name)
    turns, places = move.turn @ rigid.rotations, move.points(rigid.translations)
    rigid = replace(rigid, rotations=turns, translations=places)
    first = torch.zeros(len(frames[0]), INFLUENCES)
    bound = first.long(), torch.cat((first[:, :1] + 1, first[:, 1:]), 1)
    return Entity(carried(name, frames, rigid_joint(rigid), bound, eyes, modes), rigid)


@torch.no_grad()
def at_rest(request: ExportRequest, motion: BodyMotion) -> Gaussians:
    """The Gaussians of a person in the zero pose of its body, of the mean colours of some moments.

    Args:
        motion: in the world of the clip.
    """
    some = np.unique(np.linspace(0, len(motion) - 1, NEAR).round().astype(int)).tolist()
    frames = [request.scene(request.moments[i], [motion.name]).gaussians[motion.name] for i in some]
    frames = [g.detach().to("cpu", torch.float32) for g in frames]
    joints = body_joints(motion)
    joints = Joints(joints.transforms[some], joints.turns[some])
    few = replace(motion, rotations=motion.rotations[some], transl=motion.transl[some])
    bound = body_weights(request, few, torch.stack([g.means for g in frames]))
    return carried(motion.name, frames, joints, bound, eyes_of(request.clip), 0).gaussians
