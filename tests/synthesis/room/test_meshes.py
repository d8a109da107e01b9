from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hoigs.synthesis.meshes import TexturedMesh, ball, box, cylinder, lathe, smooth_normals
from hoigs.synthesis.object_motions import bend_points, deformed_mesh
from hoigs.synthesis.room import Palette, Stand, build_room

SOLIDS = {
    "box": lambda: box((0.3, 0.2, 0.5), 0),
    "strips": lambda: box((0.3, 0.2, 0.5), 0, columns=4),
    "ball": lambda: ball(0.4, 0),
    "cylinder": lambda: cylinder(0.2, 1.0, 0),
}


def _against_winding(mesh: TexturedMesh) -> np.ndarray:
    """Cosine of each corner normal with its face's own normal."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    size = np.linalg.norm(flat, axis=-1)
    keep = size > 1e-7  # a ball's poles
    cosine = np.einsum("fi,fci->fc", flat, mesh.normals) / np.maximum(size, 1e-12)[:, None]
    return cosine[keep]


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_point_out_of_solids(name: str) -> None:
    mesh = SOLIDS[name]()
    assert _against_winding(mesh).min() > 0.7
    middle = mesh.vertices.mean(0)
    corners = mesh.vertices[mesh.faces]
    outward = np.einsum("fci,fci->fc", corners - middle, mesh.normals)
    assert (outward > 0).all()


def test_a_box_is_closed_and_has_its_volume() -> None:
    mesh = box((0.3, 0.2, 0.5), 0)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)  # merges the doubled corners
    assert solid.is_watertight
    assert solid.volume == pytest.approx(0.03)


def test_each_face_of_a_box_shows_its_whole_texture_once() -> None:
    mesh = box((0.3, 0.2, 0.5), [3, 1, 4, 1, 5, 9], columns=3)
    a, b, c = (mesh.uv[:, k] for k in range(3))
    (p, q), (r, s) = (b - a).T, (c - a).T
    area = 0.5 * np.abs(p * s - q * r)
    assert area.sum() == pytest.approx(6.0)
    right = mesh.normals[:, 0, 0] > 0.5
    assert set(mesh.texture[right]) == {3}


def test_a_picture_is_upright_seen_from_the_front() -> None:
    mesh = box((2.0, 2.0, 2.0), 0)
    front = mesh.normals[:, 0, 2] > 0.5
    corners, uv = mesh.vertices[mesh.faces[front]], mesh.uv[front]
    # seen from +z: u grows along x, v grows downwards
    np.testing.assert_allclose(uv[..., 0], (corners[..., 0] + 1) / 2)
    np.testing.assert_allclose(uv[..., 1], (1 - corners[..., 1]) / 2)


def test_every_prop_of_the_room_faces_outward() -> None:
    room = build_room(Palette(), [Stand(0.4, 0.4, 0.5)], seed=0)
    assert _against_winding(room.shell).min() > 0.999
    assert _against_winding(room.props).min() > 0.5
    # the shell looks inward: every wall's normal points to the middle of the room
    corners = room.shell.vertices[room.shell.faces]
    inward = np.einsum("fci,fci->fc", np.array([0, 1.3, 1.0]) - corners, room.shell.normals)
    assert (inward > 0).all()


def test_smooth_normals_of_a_ball_are_radial() -> None:
    mesh = trimesh.creation.icosphere(3)
    normals = smooth_normals(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert (normals * mesh.vertices).sum(-1).min() > 0.999


def test_bending_keeps_the_middle_line_s_length_and_is_smooth_at_zero() -> None:
    line = np.stack((np.linspace(-0.3, 0.3, 400), np.zeros(400), np.zeros(400)), -1)
    bent, rotation = bend_points(line, 1.8, 0.6)
    length = np.linalg.norm(np.diff(bent, axis=0), axis=-1).sum()
    assert length == pytest.approx(0.6, rel=1e-4)
    ends = np.degrees(np.arccos((np.trace(rotation[0].T @ rotation[-1]) - 1) / 2))
    assert ends == pytest.approx(np.degrees(1.8), rel=1e-6)
    np.testing.assert_allclose(bend_points(line, 1e-7, 0.6)[0], line, atol=1e-7)


def test_a_hinge_bends_at_its_middle_alone() -> None:
    line = np.stack((np.linspace(-0.3, 0.3, 401), np.zeros(401), np.zeros(401)), -1)
    bent, _ = bend_points(line, 1.2, 0.012)
    steps = np.diff(bent, axis=0)
    angle = np.arctan2(-steps[:, 2], steps[:, 0])
    np.testing.assert_allclose(angle[:190], -0.6, atol=1e-6)
    np.testing.assert_allclose(angle[-190:], 0.6, atol=1e-6)


@pytest.mark.parametrize(
    "bend, width, squeeze", [(1.2, 0.6, 1.0), (1.2, 0.012, 1.0), (0.0, 0.6, 0.7)]
)
def test_a_deformed_mesh_keeps_normals_on_its_surface(
    bend: float, width: float, squeeze: float
) -> None:
    columns = 24 if width > 0.1 else 2  # more would cross at the inner side of a hinge
    mesh = deformed_mesh(box((0.6, 0.1, 0.1), 0, columns), bend, width, squeeze)
    assert _against_winding(mesh).min() > (0.99 if columns == 24 else 0.8)


def test_a_squeezed_ball_keeps_its_volume_and_its_normals() -> None:
    whole, soft = (deformed_mesh(ball(0.15, 0), 0.0, 0.3, squeeze) for squeeze in (1.0, 0.7))
    volumes = [trimesh.Trimesh(m.vertices, m.faces).volume for m in (whole, soft)]
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)
    assert np.ptp(soft.vertices[:, 0]) == pytest.approx(0.7 * np.ptp(whole.vertices[:, 0]))
    assert _against_winding(soft).min() > 0.7


def test_moving_a_mesh_moves_its_normals() -> None:
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    mesh = lathe([(0.1, 0.2), (0.2, 0.0)], 0).moved(turn, (1, 2, 3))
    assert _against_winding(mesh).min() > 0.7
