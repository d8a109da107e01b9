"""mesh-sequence: trimesh reads the body's surface and a closed object that move as ours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from hoigs.plugins.exporters.mesh_sequence import MeshSequenceConfig, MeshSequenceExporter
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
        thing.merge_vertices()
        assert thing.is_watertight
        assert np.abs(thing.bounds - [means.min(0), means.max(0)]).max() < 0.1
