"""tracks: what is read back is where objects, cameras and hands are; pycolmap reads it too."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import torch

from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.plugins.exporters.tracks import TracksExporter


@pytest.fixture(scope="module")
def written(request_of, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracks") / "out"
    request = request_of(slow=2.0)
    TracksExporter().export(request, folder)
    return request, folder


def test_the_object_moves_as_its_gaussians(written):
    request, folder = written
    rows = json.loads((folder / "tracks.json").read_text())["objects"]
    assert [r["frame"] for r in rows] == [f"{i / 2:.4f}" for i in range(7)]
    with torch.no_grad():
        clouds = [request.scene(m).gaussians["object"].means for m in request.moments]

    def pose(row):
        quat = torch.tensor([row[k] for k in ("qw", "qx", "qy", "qz")])
        return quats_to_matrices(quat), torch.tensor([row[k] for k in "xyz"])

    turn, place = pose(rows[0])
    own = (clouds[0] - place) @ turn
    for row, cloud in zip(rows, clouds, strict=True):
        turn, place = pose(row)
        assert (own @ turn.mT + place - cloud).norm(dim=-1).mean() < 5e-3
    track = request.clip.objects["object"]
    assert (pose(rows[2])[1] - track.translations[1]).norm() < 0.03


def test_pycolmap_reads_the_cameras(written):
    import pycolmap

    request, folder = written
    model = pycolmap.Reconstruction(folder / "colmap")
    assert len(model.images) == 7
    for i in (1, 3):  # images of whole frames 0 and 1
        camera = request.clip.cameras[(i - 1) // 2]
        image = model.images[i]
        view = image.cam_from_world
        view = (view() if callable(view) else view).matrix()
        assert np.allclose(view, camera.world_to_camera[:3].numpy(), atol=1e-5)
        K = model.cameras[image.camera_id].calibration_matrix()
        assert np.allclose(K, camera.K.numpy(), atol=1e-4)


def test_contacts_are_distances_of_hands(written):
    folder = written[1]
    with (folder / "contacts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 7 * 2 and {r["hand"] for r in rows} == {"left", "right"}
    near = [float(r["distance"]) for r in rows]
    assert 0 <= min(near) < 0.3 and max(near) < 2
    assert all(int(r["contact"]) == (float(r["distance"]) < 0.02) for r in rows)
