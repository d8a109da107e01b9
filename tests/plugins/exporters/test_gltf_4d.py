"""exporter:gltf-4d, read by its documentation: what it plays is the run."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import numpy as np
import torch
from gltf_file import Read, khronos_finds_nothing
from scipy.spatial.transform import Rotation

from hoigs.core.maths.rotations import axis_angle_to_quats, multiply_quats, quats_to_matrices
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.plugins.exporters.carried import PARTS, Joints, carried, same
from hoigs.plugins.exporters.glb import NAME
from hoigs.plugins.exporters.gltf_4d import EXTENSION, Gltf4dConfig, Gltf4dExporter
from hoigs.plugins.exporters.posed import Move

EYES = [torch.tensor((0.0, 0.0, -4.0))]


def cloud(count: int = 200) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(count, 3, generator=generator)
    made = Gaussians.from_points(points, torch.rand(count, 3, generator=generator), opacity=0.8)
    return made.replace(quats=torch.randn(count, 4, generator=generator))


def test_what_joints_and_two_modes_explain_is_exact() -> None:
    base, times = cloud(), torch.linspace(0, 1, 7)
    joints, frames = [], []
    for t in times:
        quat = axis_angle_to_quats(torch.tensor((0.2, 1.5, 0.1)) * t)
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = quats_to_matrices(quat), torch.tensor((0.5, 0.0, 1.0)) * t
        joints.append((pose, quat))
        swollen = base.means * (1 + 0.1 * torch.sin(3 * t))
        frames.append(
            base.replace(
                means=swollen @ pose[:3, :3].mT + pose[:3, 3],
                quats=multiply_quats(quat.expand(len(base), 4), base.quats),
                sh=base.sh * (1 - 0.3 * t),
            )
        )
    poses = Joints(*(torch.stack(x)[:, None] for x in zip(*joints, strict=True)))
    bound = torch.zeros(200, 4).long(), torch.eye(4)[:1].expand(200, 4)
    found = [carried("a", frames, poses, bound, EYES, most) for most in (0, 2)]
    assert found[0].left_mm > 20 and found[0].left_color > 0.02
    assert found[1].left_mm < 0.01 and found[1].left_color < 1e-4
    assert {k: m.shape[-1] for k, m in found[1].modes.items()} == PARTS
    assert same(base, base) and not same(base, frames[1])


def moments(read: Read, frame: int) -> Iterator[tuple[str, Gaussians]]:
    """The Gaussians of every mesh at a moment, by the page on the format."""
    for node in (n for n in read.json["nodes"] if "mesh" in n):
        shape = read.json["meshes"][node["mesh"]]["primitives"][0]
        get = lambda key: read.array(shape["attributes"][key])  # noqa: B023, E731
        points, quats = get("POSITION"), get(f"{NAME}:ROTATION")
        color = 0.5 + SH_C0 * get(f"{NAME}:SH_DEGREE_0_COEF_0")
        opacity, grown = get(f"{NAME}:OPACITY"), np.zeros_like(points)
        more = shape["extensions"][NAME].get("extensions", {}).get(EXTENSION, {"bufferView": None})
        data = zlib.decompress(read.view(more["bufferView"])) if len(more) > 1 else b""

        count = len(points)

        def part(entry, width, data=data, count=count):
            if entry is None:
                return np.zeros((count, width))
            codes = np.frombuffer(data, np.int8, width * count, entry["offset"])
            return codes.reshape(width, count).T / 127 * entry["step"]

        index = read.json["nodes"].index(node)
        weights = read.animated(index, "weights", frame)
        for k, target in enumerate(shape.get("targets", [])):
            own = more["targets"][k] if "targets" in more else {}
            points = points + weights[k] * read.array(target["POSITION"])
            quats = quats + weights[k] * part(own.get("ROTATION"), 4)
            color = color + weights[k] * part(own.get("COLOR"), 3)
            opacity = opacity + weights[k] * part(own.get("OPACITY"), 1)
            grown = grown + weights[k] * part(own.get("SCALE"), 3)
        if "skin" in node:
            skin = read.json["skins"][node["skin"]]
            inverse = read.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
            bones = np.stack([read.world(j, frame) for j in skin["joints"]]) @ inverse
            chosen = get("JOINTS_0").astype(int), get("WEIGHTS_0")
        else:
            bones = read.world(index, frame)[None]
            chosen = np.zeros((len(points), 1), int), np.ones((len(points), 1))
        size = np.cbrt(np.linalg.det(bones[0, :3, :3]))
        moves = np.einsum("nk,nkab->nab", chosen[1], bones[chosen[0]])
        points = (moves[:, :3, :3] @ points[..., None])[..., 0] + moves[:, :3, 3]
        # near a joint the mean of the rotations is nearly that of the quaternions
        turns = Rotation.from_matrix(np.linalg.svd(moves[:, :3, :3] / size)[0]
                                     @ np.linalg.svd(moves[:, :3, :3] / size)[2])  # fmt: skip
        turned = (turns * Rotation.from_quat(quats)).as_quat()[:, [3, 0, 1, 2]]
        bands = [(color - 0.5) / SH_C0]
        if "sh" in more:
            rest = part(more["sh"], 3 * ((more["sh"]["degree"] + 1) ** 2 - 1))
            bands += list(rest.reshape(len(rest), -1, 3).transpose(1, 0, 2))
        scales = np.log(get(f"{NAME}:SCALE").clip(1e-6) * size) + grown
        opacity = np.clip(opacity[:, 0], 1e-6, 1 - 1e-6)
        arrays = (points, turned, scales, np.log(opacity / (1 - opacity)), np.stack(bands, 1))
        yield node["name"], Gaussians(*(torch.from_numpy(np.float32(x)) for x in arrays))


def test_what_the_file_plays_is_the_run(request_of, tmp_path, psnr_to_ours, upright) -> None:
    request = request_of(end=2.0)
    Gltf4dExporter(Gltf4dConfig(modes=2)).export(request, tmp_path / "out")
    path = tmp_path / "out" / "scene.glb"
    read = Read(path)
    assert {read.json["nodes"][s["joints"][0]]["name"] for s in read.json["skins"]} == {
        "human.pelvis"
    }
    move = np.float32(np.linalg.inv(upright(request, "y")))
    back = Move(torch.from_numpy(move[:3, :3]), torch.from_numpy(move[:3, 3]))
    for frame in (0, 2):
        parts = dict(moments(read, frame))
        assert set(parts) == {"scene", "human", "object"}
        drawn = back.gaussians(Gaussians.cat([parts[n] for n in request.scene.names()]))
        assert psnr_to_ours(drawn, frame) > 38, frame
    about = read.json["extensions"][EXTENSION]
    camera = read.world(about["camera"], 2)
    camera[:3, 1:3] *= -1
    theirs = np.linalg.inv(camera) @ upright(request, "y")
    assert np.allclose(theirs, request.clip.cameras[2].world_to_camera.numpy(), atol=1e-4)
    khronos_finds_nothing(path)
