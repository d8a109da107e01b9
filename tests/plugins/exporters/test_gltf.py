"""glTF: valid by the Khronos validator; the skin that is read back is the body."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from gltf_file import Read, khronos_finds_nothing
from scipy.spatial import cKDTree

from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.glb import NAME, GltfBodyConfig, GltfBodyExporter, GltfSplatExporter
from hoigs.plugins.exporters.posed import Move, body_motion, object_motion


@pytest.fixture(scope="module")
def body(request_of, tmp_path_factory):
    request = request_of("human", "object", end=2.0)
    folder = tmp_path_factory.mktemp("gltf") / "out"
    GltfBodyExporter(GltfBodyConfig(texture=64)).export(request, folder)
    return request, folder / "body.glb"


@pytest.fixture(scope="module")
def splats(request_of, tmp_path_factory):
    request = request_of()
    folder = tmp_path_factory.mktemp("splat") / "out"
    GltfSplatExporter().export(request, folder)
    return request, folder / "splats.glb"


def test_the_khronos_validator_finds_nothing(body, splats):
    khronos_finds_nothing(body[1], splats[1])


def test_the_skin_is_the_body(body, upright):
    request, path = body
    read, motion = Read(path), body_motion(request, "human")
    shape = read.json["meshes"][read.json["nodes"][read.node("human")]["mesh"]]["primitives"][0]
    skin = read.json["skins"][0]
    points = read.array(shape["attributes"]["POSITION"])
    sets = range(sum(k.startswith("JOINTS_") for k in shape["attributes"]))
    joints = np.concatenate([read.array(shape["attributes"][f"JOINTS_{k}"]) for k in sets], 1)
    weights = np.concatenate([read.array(shape["attributes"][f"WEIGHTS_{k}"]) for k in sets], 1)
    # seams of the texture cut the mesh: some vertices are there twice
    rows = cKDTree(motion.body.shaped(motion.betas)[0].numpy()).query(points)[1]
    assert len(np.unique(rows)) == len(motion.vertices(0))
    inverse = read.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    move = upright(request, "y")
    turn, shift = move[:3, :3], move[:3, 3]
    for frame in (0, 2):
        moves = np.stack([read.world(j, frame) for j in skin["joints"]]) @ inverse
        blended = np.einsum("vk,vkab->vab", weights, moves[joints.astype(int)])
        posed = (blended[:, :3, :3] @ points[..., None])[..., 0] + blended[:, :3, 3]
        away = np.linalg.norm(posed - motion.vertices(frame).numpy()[rows] @ turn.T - shift, axis=1)
        assert away.mean() < 1e-3 and np.quantile(away, 0.99) < 5e-3
        hips = read.world(skin["joints"][0], frame)[:3, 3]
        assert np.abs(hips - turn @ motion.joints(frame)[0].numpy() - shift).max() < 1e-4


def test_trimesh_reads_closed_textured_meshes(body):
    scene = trimesh.load(body[1])
    assert set(scene.geometry) == {"human", "object"}
    for mesh in scene.geometry.values():
        texture = np.asarray(mesh.visual.material.baseColorTexture)
        assert texture.ndim == 3 and texture.std() > 5 and np.ptp(mesh.visual.uv, 0).min() > 0.3
        welded = trimesh.Trimesh(mesh.vertices, mesh.faces)
        welded.merge_vertices(merge_tex=True, merge_norm=True)
        assert welded.is_watertight and welded.volume > 0
        assert (mesh.vertex_normals * (mesh.vertices - mesh.centroid)).sum(1).mean() > 0


IN_BLENDER = """
import json, runpy, sys, bpy
script, *sys.argv[1:] = sys.argv[1:]
runpy.run_path(script, run_name="__main__")
bpy.context.scene.frame_set(2)
person = bpy.data.objects["human"].evaluated_get(bpy.context.evaluated_depsgraph_get())
points = [person.matrix_world @ v.co for v in person.to_mesh().vertices]
print("BOX", json.dumps([[f(p[k] for p in points) for k in range(3)] for f in (min, max)]))
"""


def test_blender_shows_the_same_body(body, upright, tmp_path):
    python = os.environ.get("HOIGS_BPY")
    if python is None:
        pytest.skip("HOIGS_BPY names no Python that has Blender's bpy")
    request, path = body
    # as the command names the sheet of one file
    shutil.copy(path, path.with_name("named.glb"))
    shutil.copy(path.with_name("export.json"), path.with_name("named.glb.json"))
    script = Path(__file__).parents[3] / "examples" / "blender_import.py"
    wanted = tmp_path / "body.fbx", tmp_path / "run.blend"
    done = subprocess.run(
        [python, "-c", IN_BLENDER, script, path.with_name("named.glb"), "--fbx", wanted[0],
         "--save", wanted[1]],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert all(p.stat().st_size > 100_000 for p in wanted)
    box = json.loads(next(x for x in done.stdout.splitlines() if x.startswith("BOX"))[4:])
    move = upright(request, "y")
    seen = body_motion(request, "human").vertices(2).numpy() @ move[:3, :3].T + move[:3, 3]
    seen = seen[:, [0, 2, 1]] * (1, -1, 1)  # z is up in Blender
    assert np.allclose(box, (seen.min(0), seen.max(0)), atol=5e-3)


def test_objects_and_the_camera_move(body, upright):
    request, path = body
    read, motion = Read(path), object_motion(request, "object")
    turn = upright(request, "y")
    for frame in (0, 2):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = motion.rotations[frame], motion.translations[frame]
        assert np.allclose(read.world(read.node("object"), frame), turn @ pose, atol=1e-4)
        view = np.linalg.inv(request.clip.cameras[frame].world_to_camera.numpy())
        view[:3, 1:3] *= -1
        assert np.allclose(read.world(read.node("camera"), frame), turn @ view, atol=1e-4)


def test_splats_draw_the_picture(splats, psnr_to_ours, upright):
    request, path = splats
    read, parts = Read(path), []
    for mesh in read.json["meshes"]:
        shape = mesh["primitives"][0]["attributes"]
        get = lambda key: torch.from_numpy(np.float32(read.array(shape[key])))  # noqa: B023, E731
        bands = [f"{NAME}:SH_DEGREE_{d}_COEF_{k}" for d in range(4) for k in range(2 * d + 1)]
        parts.append(
            Gaussians(
                get("POSITION"), get(f"{NAME}:ROTATION")[:, [3, 0, 1, 2]],
                get(f"{NAME}:SCALE").log(), get(f"{NAME}:OPACITY")[:, 0].logit(),
                torch.stack([get(k) for k in bands if k in shape], 1),
            )
        )  # fmt: skip
    move = np.float32(np.linalg.inv(upright(request, "y")))
    back = Move(torch.from_numpy(move[:3, :3]), torch.from_numpy(move[:3, 3]))
    assert psnr_to_ours(back.gaussians(Gaussians.cat(parts)), 0) > 60
