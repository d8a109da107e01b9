"""Truth: exact geometry of a clip that knows it, read from its truth.npz."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from hoigs.core.clip import Clip
from hoigs.core.errors import ClipError
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
        from hoigs.synthesis.objects import bend_points

        vertices = self.vertices
        if self.bend[frame] != 0:
            vertices, _ = bend_points(vertices, float(self.bend[frame] / np.ptp(vertices[:, 0])))
        return vertices @ self.rotations[frame].T + self.translations[frame], self.faces

    def human_at(self, frame: int) -> tuple[Float[Array, "W 3"], Int[Array, "G 3"]]:
        """World vertices of the outer surface, clothes included, metres, and faces."""
        joints = self.transforms.shape[1]
        blended = self.weights @ self.transforms[frame, :, :3].reshape(joints, 12)
        ahead = np.concatenate((self.dressed, np.ones((len(self.dressed), 1))), 1)
        placed = np.einsum("vij,vj->vi", blended.reshape(-1, 3, 4), ahead)
        return placed, self.dressed_faces


def read_truth(clip: Clip) -> Truth | NotComputed:
    """The truth that a clip's provenance names, or why there is none.

    Raises:
        ClipError: the clip names a file that cannot be read.
    """
    name, root = clip.provenance.get("truth"), clip.store.root
    if name is None or root is None:
        return NotComputed("the clip does not know its true geometry")
    path = Path(root) / str(name)
    try:
        with np.load(path) as file:
            arrays = {field: file[key] for field, key in FIELDS.items()}
    except (OSError, ValueError, KeyError) as error:
        raise ClipError(f"{path} cannot be read ({error}); make the clip again") from error
    return Truth(**{k: v.astype(np.float64 if v.dtype.kind == "f" else np.int64)
                    for k, v in arrays.items()})  # fmt: skip
