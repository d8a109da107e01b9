"""Shape files of other tools: every documented kind is read, and damaged ones are reported."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from hoigs.core.errors import HoigsError
from hoigs.core.values.gaussians import SH_C0
from hoigs.plugins.initializers.shapes import read_points, sample_mesh

RNG = np.random.default_rng(0)
POINTS = RNG.random((50, 3)).astype("f4")
COLORS = RNG.integers(0, 256, (50, 3)).astype("u1")
RGB = [("float", k) for k in "xyz"] + [("uchar", k) for k in ("red", "green", "blue")]
SPLAT = [("float", k) for k in ("x", "y", "z", "nx", "ny", "nz")]
SPLAT += [("float", k) for k in ("f_dc_0", "f_dc_1", "f_dc_2", "opacity")]


def header(kind: str, fields: list[tuple[str, str]], count: int) -> bytes:
    lines = [f"ply\nformat {kind} 1.0\nelement vertex {count}"]
    lines += [f"property {t} {name}" for t, name in fields]
    return ("\n".join(lines) + "\nend_header\n").encode()


def ascii_ply(path, points=POINTS, colors=COLORS):
    rows = [" ".join(map(str, (*p, *c))) for p, c in zip(points, colors, strict=True)]
    path.write_bytes(header("ascii", RGB, len(points)) + ("\n".join(rows) + "\n").encode())
    return path


def check(path) -> None:
    points, colors = read_points(path)
    torch.testing.assert_close(points, torch.from_numpy(POINTS), atol=1e-6, rtol=0)
    torch.testing.assert_close(colors, torch.from_numpy(COLORS) / 255.0, atol=1e-6, rtol=0)


def test_ascii_ply(tmp_path):
    check(ascii_ply(tmp_path / "a.ply"))


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply(tmp_path, order):
    kind = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    rows = np.zeros(50, [(n, order + {"float": "f4", "uchar": "u1"}[t]) for t, n in RGB])
    for i, name in enumerate("xyz"):
        rows[name] = POINTS[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = COLORS[:, i]
    path = tmp_path / "b.ply"
    path.write_bytes(header(kind, RGB, 50) + rows.tobytes())
    check(path)


def splat_ply(path, kind: str):
    """Gaussians as 3DGS writes them: harmonics for colours, logits for opacity."""
    values = np.zeros((50, 10), "f4")
    values[:, :3] = POINTS
    values[:, 6:9] = (COLORS / 255.0 - 0.5) / SH_C0
    values[:, 9] = np.where(np.arange(50) < 40, 2.0, -6.0)
    if kind == "ascii":
        body = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in values).encode() + b"\n"
    else:
        body = values.astype("<f4").tobytes()
    path.write_bytes(header(kind, SPLAT, 50) + body)
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_splats_of_3dgs(tmp_path, kind):
    path = splat_ply(tmp_path / "s.ply", kind)
    points, colors = read_points(path)
    torch.testing.assert_close(points, torch.from_numpy(POINTS[:40]), atol=1e-6, rtol=0)
    torch.testing.assert_close(colors, torch.from_numpy(COLORS[:40]) / 255.0, atol=1e-5, rtol=0)
    assert len(read_points(path, min_opacity=1e-4)[0]) == 50


def test_glb_obj_xyz(tmp_path):
    cloud = trimesh.PointCloud(POINTS, colors=COLORS)
    trimesh.Scene([cloud]).export(tmp_path / "c.glb")
    check(tmp_path / "c.glb")
    rows = [" ".join(map(str, (*p, *c))) for p, c in zip(POINTS, COLORS, strict=True)]
    (tmp_path / "c.xyz").write_text("\n".join(rows))
    check(tmp_path / "c.xyz")
    (tmp_path / "p.xyz").write_text("0 0 1\n0 2 0\n")
    points, colors = read_points(tmp_path / "p.xyz")
    assert points.tolist() == [[0, 0, 1], [0, 2, 0]] and (colors == 0.5).all()
    (tmp_path / "v.obj").write_text("v 0 0 1\nv 0 2 0\nv 3 0 0\n")
    assert read_points(tmp_path / "v.obj")[0].tolist() == [[0, 0, 1], [0, 2, 0], [3, 0, 0]]
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([255, 0, 0, 255], (8, 1))
    box.export(tmp_path / "m.ply")
    points, colors = read_points(tmp_path / "m.ply")
    assert len(points) == 8 and (colors == torch.tensor([1.0, 0, 0])).all()


def damaged_files(folder):
    nan = POINTS.copy()
    nan[[4, 7], 1] = np.nan
    yield ascii_ply(folder / "nan.ply", nan), "2 of 50 points are NaN or infinite"
    yield ascii_ply(folder / "empty.ply", POINTS[:0], COLORS[:0]), "not a point cloud|damaged"
    yield folder / "absent.ply", "no such file"
    path = folder / "cut.ply"
    path.write_bytes(header("binary_little_endian", RGB, 50) + b"12345")
    yield path, "damaged, or no .ply file"
    path = folder / "words.ply"
    path.write_text("hello")
    yield path, "damaged, or no .ply file"
    path = folder / "words.glb"
    path.write_text("hello")
    yield path, "damaged, or no .glb file"
    path = folder / "shape.pkl"
    path.write_bytes(b"\x80\x04.")
    yield path, "cannot be read; expected one of .ply"
    path = folder / "line.obj"
    path.write_text("# nothing\n")
    yield path, "not a point cloud|damaged"


def test_damaged_files_are_distinguished(tmp_path):
    for path, message in damaged_files(tmp_path):
        with pytest.raises(HoigsError, match=message) as caught:
            read_points(path)
        assert str(path) in str(caught.value)


def test_absent_files_suggest_their_neighbours(tmp_path):
    (tmp_path / "cup.ply").touch()
    with pytest.raises(HoigsError, match=r"did you mean .cup\.ply"):
        read_points(tmp_path / "cop.ply")


def two_squares(tmp_path, suffix=".ply"):
    """A square of area 1 at x < 0 and one of area 9 at x > 0."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    vertices = np.concatenate((corners - [2, 0, 0], 3 * corners))
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    return trimesh.Trimesh(vertices, faces, process=False)


def test_samples_are_even_over_the_area(tmp_path):
    two_squares(tmp_path).export(tmp_path / "m.ply")
    points, colors = sample_mesh(tmp_path / "m.ply", 4000)
    assert len(points) == 4000 and (colors == 0.5).all()
    small = points[:, 0] < 0
    assert int(small.sum()) == pytest.approx(400, abs=60)
    assert points[~small].mean(0).tolist() == pytest.approx([1.5, 1.5, 0], abs=0.06)
    assert points[~small][:, :2].std(0).tolist() == pytest.approx([3 / 12**0.5] * 2, abs=0.03)
    assert torch.equal(points, sample_mesh(tmp_path / "m.ply", 4000)[0])
    assert not torch.equal(points, sample_mesh(tmp_path / "m.ply", 4000, seed=1)[0])


def test_colours_of_vertices_and_faces(tmp_path):
    mesh = two_squares(tmp_path)
    ramp = np.zeros((8, 4), "u1")
    ramp[:, 0] = np.where(mesh.vertices[:, 0] > 1, 255, 0)  # red grows along the large square
    mesh.visual.vertex_colors = ramp
    mesh.export(tmp_path / "v.ply")
    points, colors = sample_mesh(tmp_path / "v.ply", 500)
    large = points[:, 0] > 0
    torch.testing.assert_close(colors[large, 0], points[large, 0] / 3, atol=0.01, rtol=0)
    assert (colors[~large] == 0).all()
    mesh.visual.face_colors = [[255, 0, 0, 255]] * 2 + [[0, 0, 255, 255]] * 2
    mesh.export(tmp_path / "f.ply")
    points, colors = sample_mesh(tmp_path / "f.ply", 500)
    small = points[:, 0] < 0
    assert (colors[small] == torch.tensor([1.0, 0, 0])).all()
    assert (colors[~small] == torch.tensor([0.0, 0, 1])).all()


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_colours_of_a_texture(tmp_path, suffix):
    from PIL import Image

    picture = np.zeros((64, 64, 3), "u1")
    picture[:, :32], picture[:, 32:] = [255, 0, 0], [0, 255, 0]  # left red, right green
    mesh = two_squares(tmp_path)
    uv = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (2, 1)).astype(float)
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(picture))
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh.export(tmp_path / f"t{suffix}")
    points, colors = sample_mesh(tmp_path / f"t{suffix}", 1000)
    large = points[:, 0] > 0
    away = (points[:, 0] - 1.5).abs() > 0.1  # of the seam
    assert (colors[large & away & (points[:, 0] < 1.5)] == torch.tensor([1.0, 0, 0])).all()
    assert (colors[large & away & (points[:, 0] > 1.5)] == torch.tensor([0.0, 1, 0])).all()


def test_a_scene_of_several_meshes(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.scale_matrix(2))
    shift = trimesh.transformations.translation_matrix([10, 0, 0])
    scene.add_geometry(trimesh.creation.box(), transform=shift)
    scene.export(tmp_path / "s.glb")
    points, _ = sample_mesh(tmp_path / "s.glb", 2000)
    far = points[:, 0] > 5
    assert int(far.sum()) == pytest.approx(400, abs=2)  # a fifth of the area
    assert points[~far].abs().amax(0).tolist() == pytest.approx([1, 1, 1], abs=1e-5)


def test_what_is_no_mesh(tmp_path):
    with pytest.raises(HoigsError, match=r"initializer:points takes point clouds"):
        sample_mesh(ascii_ply(tmp_path / "c.ply"), 10)
    mesh = two_squares(tmp_path)
    mesh.vertices[1, 1] = np.nan
    mesh.export(tmp_path / "n.ply")
    with pytest.raises(HoigsError, match="1 of 8 points are NaN"):
        sample_mesh(tmp_path / "n.ply", 10)
