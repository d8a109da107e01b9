"""A small built-in clip and its exact geometry, for everything that starts an object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from hoigs.core.values.clip import Clip, FrameStore, ObjectTrack, OverStore
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin_clip


@dataclass(frozen=True)
class Truth:
    """The object as it is: a mesh about its centre, and its place in every frame."""

    mesh: trimesh.Trimesh
    rotations: Tensor
    translations: Tensor

    def distances(self, track: ObjectTrack, frame: int) -> Tensor:
        """Metres from each point, placed by its track, to the true surface of that moment."""
        world = track.points @ track.rotations[frame].mT + track.translations[frame]
        return self.to_surface((world - self.translations[frame]) @ self.rotations[frame])

    def to_surface(self, points: Tensor) -> Tensor:
        array = points.double().numpy()
        nearest = np.full(len(array), np.inf)
        for triangle in self.mesh.triangles:  # a few hundred: exact is cheap
            corners = np.broadcast_to(triangle, (len(array), 3, 3))
            foot = trimesh.triangles.closest_point(corners, array)
            nearest = np.minimum(nearest, np.linalg.norm(foot - array, axis=1))
        return torch.from_numpy(nearest)


class NoTestFrames(OverStore):
    """A store that refuses the pixels of frames that are kept for tests."""

    def __init__(self, base: FrameStore, kept: set[int]) -> None:
        super().__init__(base)
        self.kept = kept

    def _allowed(self, position: int) -> int:
        assert position not in self.kept, f"an initializer looked at test frame {position}"
        return position

    def image(self, position):
        return self.base.image(self._allowed(position))

    def mask(self, entity, position):
        return self.base.mask(entity, self._allowed(position) if entity == "object" else position)

    def depth(self, position):
        return self.base.depth(self._allowed(position))


@pytest.fixture(scope="session")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = SceneConfig.tiny(width=96, height=96, samples=1, edge_samples=1, held_out_views=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        return builtin_clip(AnnyBody(), config)


@pytest.fixture(scope="session")
def clip(clip_folder: Path) -> Clip:
    read = ClipFolderReader().read(clip_folder)
    return replace(read, store=NoTestFrames(read.store, set(read.split["test"])))


@pytest.fixture(scope="session")
def truth(clip_folder: Path) -> Truth:
    with np.load(clip_folder / "truth.npz") as file:
        mesh = trimesh.Trimesh(file["object_vertices"], file["object_faces"], process=False)
        poses = [
            torch.from_numpy(file[f"object_{k}"]).float() for k in ("rotations", "translations")
        ]
    return Truth(mesh, *poses)
