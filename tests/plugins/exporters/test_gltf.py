"""glTF: valid by the Khronos validator; the skin that is read back is the body."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.glb import NAME, GltfBodyExporter, GltfSplatExporter
from hoigs.plugins.exporters.posed import Move, body_motion, object_motion

SCRIPT = """
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[1]));
validator.validateBytes(bytes).then((r) => console.log(JSON.stringify(r.issues)));
"""


class Read:
    """A binary glTF as arrays."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, size, length = struct.unpack_from("<4sIII", data)
        assert (magic, version, size) == (b"glTF", 2, len(data))
        self.json = json.loads(data[20 : 20 + length])
        self.buffer = data[28 + length :]

    def array(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5121: "u1"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        found = np.frombuffer(self.buffer, kind, accessor["count"] * width, view["byteOffset"])
        return found.reshape(accessor["count"], width).astype(float)

    def node(self, name: str) -> int:
        return [n.get("name") for n in self.json["nodes"]].index(name)

    def world(self, index: int, frame: int) -> np.ndarray:
        """World matrix of a node at a moment."""
        node = dict(self.json["nodes"][index])
        animation = self.json["animations"][0]
        for channel in animation["channels"]:
            if channel["target"]["node"] == index:
                values = self.array(animation["samplers"][channel["sampler"]]["output"])
                node[channel["target"]["path"]] = values[frame]
        local = np.eye(4)
        turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
        local[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]))
        local[:3, 3] = node.get("translation", [0, 0, 0])
        above = [i for i, n in enumerate(self.json["nodes"]) if index in n.get("children", [])]
        return self.world(above[0], frame) @ local if above else local


@pytest.fixture(scope="module")
def body(request_of, tmp_path_factory):
    request = request_of("human", "object", end=2.0)
    folder = tmp_path_factory.mktemp("gltf") / "out"
    GltfBodyExporter().export(request, folder)
    return request, folder / "body.glb"


@pytest.fixture(scope="module")
def splats(request_of, tmp_path_factory):
    request = request_of()
    folder = tmp_path_factory.mktemp("splat") / "out"
    GltfSplatExporter().export(request, folder)
    return request, folder / "splats.glb"


def test_the_khronos_validator_finds_nothing(body, splats):
    where = os.environ.get("NODE_PATH", "")
    node = shutil.which("node")
    if node is None or not any(
        (Path(p) / "gltf-validator").is_dir() for p in where.split(":") if p
    ):
        pytest.skip("npm install gltf-validator, and name its node_modules in NODE_PATH")
    for _, path in (body, splats):
        done = subprocess.run(
            [node, "-e", SCRIPT, path], capture_output=True, text=True, check=True
        )
        issues = json.loads(done.stdout)
        bad = [m for m in issues["messages"] if m["severity"] < 2]  # errors and warnings
        # this validator does not know the extension, whose attribute names have a colon
        unknown = ("MESH_PRIMITIVE_INVALID_ATTRIBUTE", f"/attributes/{NAME}:")
        bad = [m for m in bad if m["code"] != unknown[0] or unknown[1] not in m["pointer"]]
        assert not bad, bad[:5]


def test_the_skin_is_the_body(body, upright):
    request, path = body
    read, motion = Read(path), body_motion(request, "human")
    shape = read.json["meshes"][read.json["nodes"][read.node("human")]["mesh"]]["primitives"][0]
    skin = read.json["skins"][0]
    points = read.array(shape["attributes"]["POSITION"])
    sets = range(sum(k.startswith("JOINTS_") for k in shape["attributes"]))
    joints = np.concatenate([read.array(shape["attributes"][f"JOINTS_{k}"]) for k in sets], 1)
    weights = np.concatenate([read.array(shape["attributes"][f"WEIGHTS_{k}"]) for k in sets], 1)
    inverse = read.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    move = upright(request, "y")
    turn, shift = move[:3, :3], move[:3, 3]
    for frame in (0, 2):
        moves = np.stack([read.world(j, frame) for j in skin["joints"]]) @ inverse
        blended = np.einsum("vk,vkab->vab", weights, moves[joints.astype(int)])
        posed = (blended[:, :3, :3] @ points[..., None])[..., 0] + blended[:, :3, 3]
        away = np.linalg.norm(posed - motion.vertices(frame).numpy() @ turn.T - shift, axis=1)
        assert away.mean() < 1e-3 and np.quantile(away, 0.99) < 5e-3
        hips = read.world(skin["joints"][0], frame)[:3, 3]
        assert np.abs(hips - turn @ motion.joints(frame)[0].numpy() - shift).max() < 1e-4


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
