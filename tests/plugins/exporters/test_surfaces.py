"""Surfaces: closed, through their points, and empty where a camera saw through."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.surfaces import View, isosurface, object_surface


def test_touching_solids_are_one_closed_surface() -> None:
    field = np.ones((12, 12, 12))
    field[2:6, 2:6, 2:6] = field[6:9, 6:9, 2:6] = -1  # they share an edge
    field[10, 10, 10] = -1  # apart: no part of it
    field[4, 4, 4] = 1  # a hollow
    mesh = trimesh.Trimesh(*isosurface(field), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
    assert 64 < mesh.volume < 64 + 36 + 10


def from_above(distance: float = 2.0) -> list[View]:
    """Cameras around, that look down by 50 degrees."""
    views = []
    for turn in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        forward = -np.array([np.cos(turn) * 0.64, np.sin(turn) * 0.64, 0.77])
        right = np.array([-np.sin(turn), np.cos(turn), 0.0])
        axes = np.stack((right, np.cross(forward, right), forward))
        matrix = np.column_stack((axes, axes @ (distance * forward)))
        views.append(
            View(matrix, np.array([[400, 0, 200], [0, 400, 200], [0, 0, 1.0]]), (400, 400))
        )
    return views


def painted(points: np.ndarray) -> Gaussians:
    colors = np.where(points[:, :1] > 0, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return Gaussians.from_points(
        torch.from_numpy(np.float32(points)), torch.from_numpy(np.float32(colors))
    )


def test_an_unseen_side_is_closed() -> None:
    box = trimesh.creation.box((0.4, 0.3, 0.2))
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 21)] * 3, indexing="ij"), -1).reshape(
        -1, 3
    )
    points = grid[(np.abs(grid).max(1) > 0.499) & (grid[:, 2] > -0.499)] * (0.4, 0.3, 0.2)
    found = object_surface(painted(points), from_above(), 64)
    assert found is not None
    surface, error = found
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(box.volume, rel=0.15)
    assert error < 0.005
    colors = surface.vertex_colors()
    side = surface.vertices[:, 0]
    assert colors[side > 0.1].mean(0)[0] > 0.9 and colors[side < -0.1].mean(0)[2] > 0.9


def test_a_cup_is_hollow() -> None:
    turn, height = np.meshgrid(np.linspace(0, 6.2, 60), np.linspace(0, 0.2, 20))
    around, radius = np.meshgrid(np.linspace(0, 6.2, 60), np.linspace(0, 0.13, 16))
    parts = [(r, turn, height) for r in (0.15, 0.13)]
    parts += [(radius, around, 0 * around + z) for z in (0.0, 0.02)]
    cup = [np.stack((r * np.cos(t), r * np.sin(t), z), -1).reshape(-1, 3) for r, t, z in parts]
    found = object_surface(painted(np.concatenate(cup)), from_above(), 64)
    assert found is not None
    mesh = trimesh.Trimesh(found[0].vertices, found[0].faces, process=False)
    assert mesh.is_watertight and mesh.volume < 0.6 * np.pi * 0.15**2 * 0.2


def test_a_sheet_has_none() -> None:
    flat = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9), 0.0), -1)
    assert object_surface(painted(flat.reshape(-1, 3)), from_above(), 64) is None
