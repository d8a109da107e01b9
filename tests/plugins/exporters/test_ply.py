"""exporter:ply: what is read back draws the picture of the run, also of a turned world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoigs.core.errors import HoigsError
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.maths.spherical_harmonics import rotate_sh, sh_basis
from hoigs.plugins.exporters.ply import PlyConfig, PlyExporter, parse_ply, ply_bytes


def test_the_picture_is_ours(request_of, psnr_to_ours, tmp_path):
    PlyExporter().export(request_of(start=5, end=5), tmp_path / "out")
    assert psnr_to_ours(parse_ply((tmp_path / "out" / "scene.ply").read_bytes()), 5) > 60


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_turned_world_looks_the_same_to_a_turned_camera(
    up, request_of, psnr_to_ours, upright, tmp_path
):
    request = request_of("human", "object")
    with torch.no_grad():  # training of four steps leaves the higher bands at zero
        before = request.scene.entity("object").sh.clone()
        noise = torch.randn(before.shape, generator=torch.Generator().manual_seed(0))
        request.scene.entity("object").sh.add_(0.2 * noise)
    PlyExporter(PlyConfig(up=up)).export(request, tmp_path / "out")
    back = torch.from_numpy(np.linalg.inv(upright(request, up))).float()
    camera = request.clip.cameras[0]
    camera = replace(camera, world_to_camera=camera.world_to_camera @ back)
    read = parse_ply((tmp_path / "out" / "scene.ply").read_bytes())
    assert psnr_to_ours(read, 0, request.entities, camera) > 60
    assert psnr_to_ours(read, 0, request.entities) < 40
    with torch.no_grad():
        request.scene.entity("object").sh.copy_(before)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_turn_with_the_world(degree):
    generator = torch.Generator().manual_seed(degree)
    sh = torch.randn(5, (degree + 1) ** 2, 3, generator=generator)
    turn = axis_angle_to_matrices(torch.tensor([0.4, -1.1, 2.0]))
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator), dim=-1)
    before = torch.einsum("dk,nkc->dnc", sh_basis(directions, degree), sh)
    after = torch.einsum("dk,nkc->dnc", sh_basis(directions @ turn.mT, degree), rotate_sh(sh, turn))
    torch.testing.assert_close(before, after, atol=1e-5, rtol=1e-5)


def test_other_programs_read_it(request_of, tmp_path):
    import trimesh

    request = request_of("object")
    PlyExporter().export(request, tmp_path / "out")
    data = (tmp_path / "out" / "scene.ply").read_bytes()
    with torch.no_grad():
        ours = request.scene(request.moments[0]).gaussians["object"]
    cloud = trimesh.load(tmp_path / "out" / "scene.ply", process=False)
    assert np.allclose(cloud.vertices, ours.means.numpy(), atol=1e-6)
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed")
    program = gaussforge.GaussForge()
    assert program.get_model_info(data, "ply")["data"]["basic"]["numPoints"] == len(ours)
    again = parse_ply(program.convert(data, "ply", "ply")["data"])
    torch.testing.assert_close(again.means, ours.means)
    torch.testing.assert_close(again.log_scales, ours.log_scales)


@pytest.mark.parametrize("pad_sh", [True, False])
def test_the_original_viewers_find_45_coefficients(pad_sh, request_of, tmp_path):
    request = request_of("object")
    PlyExporter(PlyConfig(pad_sh=pad_sh)).export(request, tmp_path / "out")
    head = (tmp_path / "out" / "scene.ply").read_bytes().split(b"end_header")[0]
    own = request.scene.entity("object").sh.shape[1]
    assert own < 16 and head.count(b"f_rest_") == (45 if pad_sh else 3 * (own - 1))
    read = parse_ply((tmp_path / "out" / "scene.ply").read_bytes()).sh
    with torch.no_grad():
        ours = request.scene(request.moments[0]).gaussians["object"].sh
    torch.testing.assert_close(read[:, :own], ours)
    assert not read[:, own:].any()


def test_damaged_files_are_refused(loaded):
    data = ply_bytes(loaded.model.entity("object").canonical)
    for broken, words in (
        (data[:-4], "ends before"),
        (b"ply\nformat ascii 1.0\nend_header\n", "binary little-endian"),
        (data.replace(b"float rot_3", b"float rot_4"), "rot_3"),
        (b"", "binary little-endian"),
    ):
        with pytest.raises(HoigsError, match=words):
            parse_ply(broken)
