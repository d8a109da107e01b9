"""Truth: the exact geometry of a synthetic clip, read from its truth.npz."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from hoigs.core.errors import ClipError
from hoigs.core.files.npz import load_arrays
from hoigs.core.maths.skinning import skin
from hoigs.core.values.clip import Clip
from hoigs.evaluation.protocol import NotComputed

Array = np.ndarray

FIELDS = {
    "vertices": "object_vertices",
    "faces": "object_faces",
    "rotations": "object_rotations",
    "translations": "object_translations",
    "bend": "object_bend",
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
        bend: its end-to-end angle, radians; 0 where it is rigid.
        dressed, dressed_faces: the person in the zero pose. weights, transforms: its skinning.
    """

    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    rotations: Float[Array, "T 3 3"]
    translations: Float[Array, "T 3"]
    bend: Float[Array, " T"]
    dressed: Float[Array, "W 3"]
    dressed_faces: Int[Array, "G 3"]
    weights: Float[Array, "W J"]
    transforms: Float[Array, "T J 4 4"]

    def object_at(self, frame: int) -> tuple[Float[Array, "V 3"], Int[Array, "F 3"]]:
        """World vertices, metres, and faces."""
        from hoigs.synthesis.motion.object_script import bend_points

        vertices = self.vertices
        if self.bend[frame] != 0:
            vertices, _ = bend_points(vertices, float(self.bend[frame] / np.ptp(vertices[:, 0])))
        return vertices @ self.rotations[frame].T + self.translations[frame], self.faces

    def human_at(self, frame: int) -> tuple[Float[Array, "W 3"], Int[Array, "G 3"]]:
        """World vertices of the outer surface, clothes included, metres, and faces."""
        points, transforms, weights = map(
            torch.from_numpy, (self.dressed, self.transforms[frame], self.weights)
        )
        return skin(points, transforms, weights).numpy(), self.dressed_faces


SHAPES = {
    "vertices": "V3", "faces": "F3", "rotations": "T33", "translations": "T3", "bend": "T",
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
