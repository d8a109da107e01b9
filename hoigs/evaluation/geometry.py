"""Geometry: hand-object distance as in the HOIGS supplement, and errors against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.maths.rotations import kabsch
from hoigs.core.maths.skinning import skin
from hoigs.core.model.scene import SceneModel
from hoigs.core.system.npz import load_arrays
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.evaluation.protocol import NotComputed, Value, mean_of

# Truth: the exact geometry of a synthetic clip, read from its truth.npz.

Array = np.ndarray
FIELDS = {
    "vertices": "object_vertices",
    "faces": "object_faces",
    "rotations": "object_rotations",
    "translations": "object_translations",
    "bend": "object_bend",
    "bend_width": "object_bend_width",
    "squeeze": "object_squeeze",
    "dressed": "dressed_vertices",
    "dressed_faces": "dressed_faces",
    "weights": "skinning_weights",
    "transforms": "skinning_transforms",
}


@dataclass(frozen=True)
class Truth:
    """Meshes of the object and of the clothed person at every frame.

    Attributes:
        vertices, faces: of the object, about its centre. rotations, translations: object to world.
        bend: its end-to-end angle, radians, over `bend_width` metres in its middle; squeeze: share
            of its width; 0 and 1 where it is rigid.
        dressed, dressed_faces: the person in the zero pose. weights, transforms: its skinning.
    """

    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    rotations: Float[Array, "T 3 3"]
    translations: Float[Array, "T 3"]
    bend: Float[Array, " T"]
    bend_width: Float[Array, ""]
    squeeze: Float[Array, " T"]
    dressed: Float[Array, "W 3"]
    dressed_faces: Int[Array, "G 3"]
    weights: Float[Array, "W J"]
    transforms: Float[Array, "T J 4 4"]

    def object_at(self, frame: int) -> tuple[Float[Array, "V 3"], Int[Array, "F 3"]]:
        """World vertices, metres, and faces."""
        from hoigs.synthesis.object_motions import bend_points, squeezed

        vertices = squeezed(self.vertices, float(self.squeeze[frame]))
        if self.bend[frame] != 0:
            vertices, _ = bend_points(vertices, float(self.bend[frame]), float(self.bend_width))
        return vertices @ self.rotations[frame].T + self.translations[frame], self.faces

    def human_at(self, frame: int) -> tuple[Float[Array, "W 3"], Int[Array, "G 3"]]:
        """World vertices of the outer surface, clothes included, metres, and faces."""
        parts = (self.dressed, self.transforms[frame], self.weights)
        return skin(*map(torch.from_numpy, parts)).numpy(), self.dressed_faces


SHAPES = {
    "vertices": "V3", "faces": "F3", "rotations": "T33", "translations": "T3", "bend": "T",
    "bend_width": "", "squeeze": "T",
    "dressed": "W3", "dressed_faces": "G3", "weights": "WJ", "transforms": "TJ44",
}  # fmt: skip
INDICES = {"faces": "vertices", "dressed_faces": "dressed"}


def _check(path: Path, arrays: dict[str, Array], frames: int) -> None:
    """ClipError unless all arrays fit each other: they are used after a long training."""
    sizes: dict[str, int] = {}
    for field, form in SHAPES.items():
        got, kind = arrays[field], "iu" if field in INDICES else "f"
        expected = [int(s) if s.isdigit() else sizes.setdefault(s, n)
                    for s, n in zip(form, got.shape)]  # fmt: skip
        if got.dtype.kind not in kind or got.ndim != len(form) or list(got.shape) != expected:
            named = ", ".join(f"{s}={sizes[s]}" if s in sizes else s for s in form)
            raise ClipError(
                f"{path}: {FIELDS[field]} is {got.dtype} of shape {list(got.shape)}, expected "
                f"[{named}]; make the clip again"
            )
        if kind == "f" and not np.isfinite(got).all():
            raise ClipError(f"{path}: {FIELDS[field]} is not finite; make the clip again")
    if sizes["T"] < frames:
        raise ClipError(f"{path}: of {sizes['T']} frames, the clip has {frames}")
    for field, of in INDICES.items():
        faces, count = arrays[field], len(arrays[of])
        if faces.size and not 0 <= int(faces.min()) <= int(faces.max()) < count:
            raise ClipError(f"{path}: {FIELDS[field]} names vertices that are not there")


def read_truth(clip: Clip) -> Truth | NotComputed:
    """The truth that a clip's provenance names, or why there is none.

    Raises:
        ClipError: the clip names a file that cannot be read.
    """
    name, root = clip.provenance.get("truth"), clip.store.root
    if name is None or root is None:
        return NotComputed("the clip has no true geometry")
    path = Path(root) / str(name)
    if not path.resolve().is_relative_to(Path(root).resolve()):
        raise ClipError(f"{path} is outside of the clip's folder {root}; copy the file into it")
    if not path.is_file():
        return NotComputed(f"the clip's {name} is absent")
    try:
        file = load_arrays(path, FIELDS.values())
        arrays = {field: file[key] for field, key in FIELDS.items()}
    except (OSError, ValueError, KeyError) as error:
        raise ClipError(f"{path} cannot be read ({error}); make the clip again") from error
    _check(path, arrays, 1 + max(moment.index for moment in clip.moments))
    return Truth(**{k: v.astype(np.float64 if v.dtype.kind == "f" else np.int64)
                    for k, v in arrays.items()})  # fmt: skip


HANDS = (8, 9)  # of hoigs.core.interfaces.body.PART_NAMES: left and right
SOLID = 0.5  # smallest opacity of a Gaussian that counts as a point of a surface
SAMPLES = 20_000  # points drawn from a true surface
GEOMETRY: Mapping[str, str] = {
    "cd_best": "hand to object CD_best m² ↓",
    "object_rotation": "object rotation error ° ↓",
    "object_translation": "object translation error mm ↓",
    "object_accuracy": "object accuracy mm ↓",
    "object_completeness": "object completeness mm ↓",
    "object_chamfer": "object Chamfer mm ↓",
    "human_accuracy": "human accuracy mm ↓",
    "human_completeness": "human completeness mm ↓",
    "human_chamfer": "human Chamfer mm ↓",
}
NOTES = (
    "Points are the centres of Gaussians of opacity 0.5 or more. CD_best: (mean squared distance "
    "object to hand + hand to object) / 2 of the nearer hand, metres² (HOIGS, supplement, "
    "Geometry Evaluation of Interaction); it measures distance, not accuracy: interpenetration "
    "lowers it.",
    "Against the truth: accuracy is the mean distance of points to the true surface, completeness "
    "that of the surface to the points, Chamfer their mean. Object pose: the rigid motion of its "
    "points from one training frame, against the true one; translation at the object's centre.",
)


class SurfaceError(NamedTuple):
    """Mean distances in the units of the input: points to surface, surface to points."""

    accuracy: float
    completeness: float

    @property
    def chamfer(self) -> float:
        return (self.accuracy + self.completeness) / 2


def chamfer_squared(a: Float[Array, "A 3"], b: Float[Array, "B 3"]) -> float:
    """d_CD: half the sum of both mean squared nearest distances (HOIGS, supplement)."""
    a_to_b, _ = cKDTree(b).query(a)
    b_to_a, _ = cKDTree(a).query(b)
    return 0.5 * float((a_to_b**2).mean() + (b_to_a**2).mean())


def best_hand(points: Float[Array, "O 3"], hands: Sequence[Float[Array, "_ 3"]]) -> float:
    """CD_best: the distance of the object's points to the nearer hand, units squared."""
    return min(chamfer_squared(points, hand) for hand in hands)


def surface_error(
    points: Float[Array, "N 3"], vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]
) -> SurfaceError:
    """Distances between points and a triangle mesh.

    Each point is measured to candidate triangles: those with the nearest of 20,000 samples (which
    finds large triangles) and those with the nearest centres (which finds small ones).
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    samples, owners = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    _, near = cKDTree(samples).query(points, k=4)
    _, small = cKDTree(mesh.triangles_center).query(points, k=min(8, len(faces)))
    candidates = np.concatenate((owners[near], small.reshape(len(points), -1)), 1)
    repeated = np.repeat(points, candidates.shape[1], axis=0)
    closest = trimesh.triangles.closest_point(mesh.triangles[candidates.ravel()], repeated)
    to_surface = np.linalg.norm(closest - repeated, axis=-1).reshape(candidates.shape).min(1)
    from_surface, _ = cKDTree(points).query(samples)
    return SurfaceError(float(to_surface.mean()), float(from_surface.mean()))


def rigid_motion(
    start: Float[Array, "N 3"], end: Float[Array, "N 3"]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """R, t of least squares with end = R start + t."""
    R = kabsch(torch.as_tensor(start), torch.as_tensor(end)).numpy()
    return R, end.mean(0) - R @ start.mean(0)


@torch.no_grad()
def measure_geometry(model: SceneModel, clip: Clip, positions: Sequence[int]) -> dict[str, Value]:
    """Every measure of GEOMETRY as its mean over some frames of a clip, or why there is none."""
    if not positions:
        return dict.fromkeys(GEOMETRY, NotComputed("no frames of the clip are scored"))
    truth = read_truth(clip)
    moments = {p: clip.moments[p].to(model.device) for p in positions}
    states = {p: dict(model(m).gaussians) for p, m in moments.items()}
    measured: dict[str, Value] = {
        "cd_best": mean_of([_cd_best(model, s) for s in states.values()])[0]
    }
    measured |= _pose_error(model, clip, truth, states)
    for kind in ("object", "human"):
        measured |= _surface(model, clip, truth, states, kind)
    return {name: measured[name] for name in GEOMETRY}


def _cd_best(model: SceneModel, gaussians: Mapping[str, Gaussians]) -> Value:
    objects = [_solid(gaussians[n]) for n in model.names("object")]
    objects = [points for points in objects if len(points)]
    if not objects:
        return NotComputed(_no_entity(model, "object"))
    hands = []
    for name in model.names("human"):
        deformation = model.entity(name).deformation
        if not isinstance(deformation, ProvidesSkeleton):
            return NotComputed(f"{type(deformation).__name__} has no body parts, so no hands")
        parts = deformation.point_parts().cpu().numpy()
        solid = _is_solid(gaussians[name])
        means = _array(gaussians[name])
        hands += [means[solid & (parts == hand)] for hand in HANDS]
    hands = [points for points in hands if len(points)]
    if not hands:
        return NotComputed(_no_entity(model, "human"))
    return min(best_hand(points, hands) for points in objects)


def _pose_error(
    model: SceneModel,
    clip: Clip,
    truth: Truth | NotComputed,
    states: Mapping[int, Mapping[str, Gaussians]],
) -> dict[str, Value]:
    """Rotation (degrees) and translation (millimetres) of the motion from a training frame."""
    names = ("object_rotation", "object_translation")
    reason = _why_not(model, truth, "object")
    train = list(clip.split.get("train", ()))
    if reason is None and not train:
        reason = "the clip has no training frames to start from"
    if reason is not None:
        return dict.fromkeys(names, NotComputed(reason))
    assert isinstance(truth, Truth)
    start = clip.moments[train[0]]
    canonical = model(start.to(model.device), ["object"]).gaussians["object"]
    solid = _is_solid(canonical)
    if solid.sum() < 3:
        return dict.fromkeys(names, NotComputed("the object has fewer than 3 solid Gaussians"))
    before, turns, shifts = _array(canonical)[solid], [], []
    R0, c0 = truth.rotations[start.index], truth.translations[start.index]
    for position, state in states.items():
        frame = clip.moments[position].index
        R, t = rigid_motion(before, _array(state["object"])[solid])
        true_turn = truth.rotations[frame] @ R0.T
        turns.append(float(np.degrees(Rotation.from_matrix(R @ true_turn.T).magnitude())))
        shifts.append(1000 * float(np.linalg.norm(R @ c0 + t - truth.translations[frame])))
    return dict(zip(names, (mean_of(turns)[0], mean_of(shifts)[0]), strict=True))


def _surface(
    model: SceneModel,
    clip: Clip,
    truth: Truth | NotComputed,
    states: Mapping[int, Mapping[str, Gaussians]],
    kind: str,
) -> dict[str, Value]:
    names = tuple(f"{kind}_{measure}" for measure in ("accuracy", "completeness", "chamfer"))
    reason = _why_not(model, truth, kind)
    if reason is not None:
        return dict.fromkeys(names, NotComputed(reason))
    assert isinstance(truth, Truth)
    mesh: Callable[[int], tuple[Array, Array]]
    mesh = truth.object_at if kind == "object" else truth.human_at
    rows: list[tuple[Value, Value, Value]] = []
    for position, state in states.items():
        points = _solid(state[kind])
        if len(points) < 6:
            none = NotComputed(f"the {kind} has fewer than 6 solid Gaussians")
            rows.append((none, none, none))
            continue
        error = surface_error(points, *mesh(clip.moments[position].index))
        rows.append((1000 * error.accuracy, 1000 * error.completeness, 1000 * error.chamfer))
    return {name: mean_of([row[i] for row in rows])[0] for i, name in enumerate(names)}


def _why_not(model: SceneModel, truth: Truth | NotComputed, kind: str) -> str | None:
    """Why the entity named `kind`, the one that the truth describes, cannot be measured."""
    if isinstance(truth, NotComputed):
        return truth.reason
    return None if kind in model.names(kind) else _no_entity(model, kind)


def _no_entity(model: SceneModel, kind: str) -> str:
    if not model.names(kind):
        return f"the model has no separate {kind}"
    part = "hand of the human" if kind == "human" else kind
    return f"no Gaussian of the {part} has opacity {SOLID} or more"


def _is_solid(gaussians: Gaussians) -> Array:
    solid = (gaussians.opacity_logits.sigmoid() >= SOLID) & gaussians.means.isfinite().all(-1)
    return solid.cpu().numpy()


def _array(gaussians: Gaussians) -> Float[Array, "N 3"]:
    return np.asarray(gaussians.means.detach().double().cpu())


def _solid(gaussians: Gaussians) -> Float[Array, "N 3"]:
    return _array(gaussians)[_is_solid(gaussians)]
