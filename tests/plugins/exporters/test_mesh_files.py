"""mesh-sequence: trimesh reads the body's surface and a closed object that move as ours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from hoigs.plugins.exporters.mesh_sequence import (
    MeshSequenceConfig,
    MeshSequenceExporter,
    alpha_shape,
)
from hoigs.plugins.exporters.posed import body_motion


@pytest.mark.parametrize("file", ["ply", "obj", "glb"])
def test_surfaces_come_back(file, request_of, upright, tmp_path):
    request = request_of("human", "object", end=2.0)
    MeshSequenceExporter(MeshSequenceConfig(file=file)).export(request, tmp_path / "out")
    move = upright(request, "y")
    turn, shift = move[:3, :3], move[:3, 3]
    for i in (0, 2):
        path = tmp_path / "out" / "human" / f"frame_{i:04d}.{file}"
        mesh = trimesh.load(path, process=False, force="mesh")
        ours = body_motion(request, "human").vertices(i).numpy() @ turn.T + shift
        assert np.abs(mesh.vertices - ours).max() < 1e-4
        thing = trimesh.load(
            tmp_path / "out" / "object" / f"frame_{i:04d}.{file}", process=False, force="mesh"
        )
        with torch.no_grad():
            means = request.scene(request.moments[i]).gaussians["object"].means.numpy()
        means = means @ turn.T + shift
        assert len(thing.faces) > 20
        assert np.abs(thing.bounds - [means.min(0), means.max(0)]).max() < 0.1


def test_the_alpha_shape_of_a_ball_is_a_closed_ball():
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(3000, 3, generator=generator), dim=1)
    points = points * torch.rand(3000, 1, generator=generator) ** (1 / 3)
    mesh = trimesh.Trimesh(points.numpy(), alpha_shape(points, 4.0).numpy(), process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.12)
    assert len(alpha_shape(points[:4], 4.0)) == 0
    flat = points * torch.tensor((1.0, 1.0, 0.0))
    assert len(alpha_shape(flat, 4.0)) == 0
