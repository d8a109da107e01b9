"""Distances against closed forms; a model that is the truth itself has no error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.evaluation.geometry import (
    GEOMETRY,
    Truth,
    best_hand,
    chamfer_squared,
    measure_geometry,
    read_truth,
    rigid_motion,
    surface_error,
)
from hoigs.evaluation.protocol import NotComputed
from hoigs.evaluation.scores import geometry_table
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.synthesis import SceneConfig, builtin_clip


def test_chamfer_is_half_the_sum_of_both_mean_squares() -> None:
    thing = np.array([[0.0, 0, 0], [0, 0, 3.0]])
    hand = np.array([[1.0, 0, 0]])
    # object to hand: (1 + 10) / 2, hand to object: 1
    assert chamfer_squared(thing, hand) == pytest.approx(0.5 * (5.5 + 1))
    assert chamfer_squared(hand, thing) == pytest.approx(0.5 * (5.5 + 1))
    assert chamfer_squared(thing, thing) == 0
    others = [np.concatenate((hand, hand)) + 9, hand, hand - 9]  # left and right differ in points
    assert best_hand(thing, others) == pytest.approx(3.25)


def test_distances_to_a_surface_are_to_its_triangles() -> None:
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    grid = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 10), np.linspace(-0.9, 0.9, 10)), -1)
    top = np.concatenate((grid.reshape(-1, 2), np.full((100, 1), 1.005)), 1)
    error = surface_error(top, box.vertices, box.faces)
    assert error.accuracy == pytest.approx(0.005, abs=1e-9)
    # the far side is 2 and more away
    assert error.completeness > 0.5 and error.chamfer == (error.accuracy + error.completeness) / 2
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    shell = surface_error(1.1 * ball.vertices, ball.vertices, ball.faces)
    assert shell.accuracy == pytest.approx(0.1, abs=2e-3)
    assert shell.completeness == pytest.approx(0.1, abs=0.01)


def test_a_rigid_motion_is_found_and_never_a_mirror() -> None:
    rng = np.random.default_rng(0)
    start = rng.normal(size=(40, 3))
    turn, shift = Rotation.random(random_state=1).as_matrix(), np.array([0.3, -2, 1])
    R, t = rigid_motion(start, start @ turn.T + shift)
    np.testing.assert_allclose(R, turn, atol=1e-9)
    np.testing.assert_allclose(t, shift, atol=1e-9)
    mirrored, _ = rigid_motion(start, start * [1, 1, -1])
    assert np.linalg.det(mirrored) == pytest.approx(1)


class Follow(DeformationModel):
    """Points that ride on tracks: [T, N, 3] world positions, by frame number."""

    entity = "human"

    def __init__(self, tracks: Tensor, parts: Tensor | None = None) -> None:
        super().__init__()
        self.tracks, self.parts = tracks, parts
        if parts is not None:
            self.provides = frozenset({"skeleton"})

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        del residual
        return replace(canonical, means=self.tracks[moment.index])

    def point_parts(self) -> Tensor:
        assert self.parts is not None
        return self.parts

    def pose(self, moment: Moment) -> None: ...

    def anchors(self, moment: Moment) -> None: ...

    def arm_length(self) -> None: ...


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """A built-in clip of 8 frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        config = SceneConfig.tiny(frames=8, width=16, height=16, samples=1, edge_samples=1,
                                held_out_views=0, test_frames=2)  # fmt: skip
        return ClipFolderReader().read(builtin_clip(AnnyBody(), config))


@pytest.fixture(scope="module")
def truth(known: Clip) -> Truth:
    found = read_truth(known)
    assert isinstance(found, Truth)
    return found


def _entity(tracks: np.ndarray, kind: str, parts: Tensor | None = None) -> Entity:
    points = torch.from_numpy(tracks).float()
    canonical = Gaussians.from_points(points[0], scales=0.01, opacity=0.9)
    return Entity(canonical, Follow(points, parts), kind=kind)  # type: ignore[arg-type]


def _things(truth: Truth) -> np.ndarray:
    """Points on the object's true surface at every frame."""
    mesh = trimesh.Trimesh(truth.vertices, truth.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 600, seed=3)
    return np.einsum("tij,nj->tni", truth.rotations, points) + truth.translations[:, None]


def _true_model(truth: Truth, things: np.ndarray) -> SceneModel:
    humans = np.stack([truth.human_at(f)[0] for f in range(len(things))])
    parts = AnnyBody().vertex_parts
    return SceneModel(
        {"human": _entity(humans, "human", parts), "object": _entity(things, "object")},
        rasterizer=TorchRasterizer(),
    )


def test_the_truth_has_no_error(known: Clip, truth: Truth) -> None:
    things = _things(truth)
    model = _true_model(truth, things)
    found = measure_geometry(model, known, known.split["test"])
    assert list(found) == list(GEOMETRY)
    for name in ("object_rotation", "object_translation", "object_accuracy", "human_accuracy"):
        assert found[name] < 0.02, name
    assert 1 < found["object_completeness"] < 20  # 600 points stand centimetres apart
    assert 0.5 < found["human_completeness"] < 10
    assert found["object_chamfer"] == pytest.approx(
        (found["object_accuracy"] + found["object_completeness"]) / 2
    )
    parts, expected = AnnyBody().vertex_parts.numpy(), []
    for frame in known.split["test"]:
        hands = [truth.human_at(frame)[0][parts == hand] for hand in (8, 9)]
        apart = [((things[frame][:, None] - h[None]) ** 2).sum(-1) for h in hands]
        expected.append(min(0.5 * (d.min(0).mean() + d.min(1).mean()) for d in apart))
    assert found["cd_best"] == pytest.approx(np.mean(expected), rel=1e-3)


def test_a_turned_and_shifted_object_is_told_by_how_much(known: Clip, truth: Truth) -> None:
    off = truth.rotations.copy()
    five = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix()
    off[1:] = five @ off[1:]  # the first training frame stays right
    moved = replace(truth, rotations=off, translations=truth.translations + np.array([0, 0.03, 0]))
    found = measure_geometry(_true_model(truth, _things(moved)), known, known.split["test"])
    assert found["object_rotation"] == pytest.approx(5, abs=1e-2)
    # the path starts 3 cm too high, so that its centre is turned about a place 3 cm below
    assert found["object_translation"] < 30
    assert 3 < found["object_accuracy"] < 30
    assert found["human_accuracy"] < 0.02


@pytest.mark.parametrize(("opacity", "counts"), [(0.49, False), (0.51, True)])
def test_transparent_gaussians_are_no_surface(
    known: Clip, truth: Truth, opacity: float, counts: bool
) -> None:
    things = _things(truth)
    strayed = np.concatenate((things, things + 5.0), 1)
    model = _true_model(truth, strayed)
    with torch.no_grad():
        model.entity("object").opacity_logits[600:] = torch.tensor(opacity).logit()
    found = measure_geometry(model, known, known.split["test"])
    assert (found["object_accuracy"] > 1000) == counts  # half of the points are 9 metres away
    assert counts or (found["object_accuracy"] < 0.02 and found["object_rotation"] < 0.02)


def test_what_cannot_be_measured_says_why(
    known: Clip, truth: Truth, clip: Clip, model: SceneModel
) -> None:
    points = Gaussians.from_points(torch.zeros(4, 3), scales=0.1, opacity=0.9)
    blob = SceneModel({"scene": Entity(points, Static())}, rasterizer=TorchRasterizer())
    found = measure_geometry(blob, known, known.split["test"])
    assert all(isinstance(v, NotComputed) for v in found.values())
    assert "has no separate object" in str(found["cd_best"])
    assert "has no separate human" in str(found["human_chamfer"])
    table = geometry_table(found)
    assert not table.rows and len(table.notes) == 2
    assert "CD_best" in table.notes[0] and "not computed" in table.notes[0]
    # a clip without truth; its model has a human without a skeleton
    toy = measure_geometry(model, clip, clip.split["test"])
    assert "has no true geometry" in str(toy["object_chamfer"])
    assert "Swing has no body parts, so no hands" in str(toy["cd_best"])
    shown = geometry_table(measure_geometry(_true_model(truth, _things(truth)), known, [3]))
    assert len(shown.rows) == len(GEOMETRY)


def test_a_damaged_truth_is_no_absent_one(known: Clip, tmp_path: Path) -> None:
    class Elsewhere(type(known.store)):  # type: ignore[misc]
        def __init__(self) -> None:
            self.root = tmp_path

    (tmp_path / "truth.npz").write_bytes(b"nothing")
    with pytest.raises(ClipError, match=r"truth\.npz cannot be read"):
        read_truth(replace(known, store=Elsewhere()))
