"""bvh, amass and smplx: joints that are read back are ours within a millimetre."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoigs.core.interfaces.body import PELVIS
from hoigs.core.values.moment import BodyPose
from hoigs.plugins.exporters.bvh import BvhConfig, BvhExporter
from hoigs.plugins.exporters.posed import body_motion
from hoigs.plugins.exporters.smpl_npz import AmassExporter, SmplxExporter


@pytest.fixture(scope="module")
def request_(request_of):
    return request_of("human", slow=2.0)


@pytest.fixture(scope="module")
def ours(request_):
    """World positions of all joints, as the scene has them."""
    motion = body_motion(request_, "human")
    return torch.stack([motion.joints(i) for i in range(len(motion))]).numpy()


def test_the_motion_is_that_of_the_avatar(request_, ours):
    avatar = request_.scene.entity("human").deformation
    for i, moment in enumerate(request_.moments):
        anchors = avatar.anchors(moment).detach().numpy()
        assert np.abs(ours[i, PELVIS] - anchors[0]).max() < 1e-5


def read_bvh(path) -> tuple[list[str], np.ndarray, float]:
    """Joint names, their world positions and the frame time, by forward kinematics in float64."""
    head, _, tail = path.read_text().partition("MOTION\n")
    names, parents, offsets, stack, site = [], [], [], [], False
    for words in map(str.split, head.splitlines()):
        if words[0] in ("ROOT", "JOINT"):
            parents.append(stack[-1] if stack else -1)
            names.append(words[1])
        elif words[:2] == ["End", "Site"]:
            site = True
        elif words[0] == "{":
            stack.append(-2 if site else len(names) - 1)
        elif words[0] == "}":
            site = False if stack.pop() == -2 else site
        elif words[0] == "OFFSET" and not site:
            offsets.append([float(x) for x in words[1:]])
        elif words[0] == "CHANNELS":
            assert words[-3:] == ["Zrotation", "Xrotation", "Yrotation"]
    lines = tail.splitlines()
    frames = np.array([[float(x) for x in line.split()] for line in lines[2:]])
    assert len(frames) == int(lines[0].split()[1])
    places = np.zeros((len(frames), len(names), 3))
    for f, row in enumerate(frames):
        turns = Rotation.from_euler("ZXY", row[3:].reshape(-1, 3), degrees=True).as_matrix()
        world = [np.eye(3)] * len(names)
        for j, parent in enumerate(parents):
            if parent < 0:
                world[j], places[f, j] = turns[j], np.add(offsets[j], row[:3])
            else:
                world[j] = world[parent] @ turns[j]
                places[f, j] = places[f, parent] + world[parent] @ offsets[j]
    return names, places, float(lines[1].split()[2])


@pytest.mark.parametrize("unit", ["m", "cm"])
def test_bvh(unit, request_, ours, upright, tmp_path):
    BvhExporter(BvhConfig(unit=unit)).export(request_, tmp_path / "out")
    names, places, step = read_bvh(tmp_path / "out" / "human.bvh")
    assert step == pytest.approx(1 / request_.fps)
    order = [names.index(n) for n in request_.bodies["human"].joint_names]
    move = upright(request_, "y")
    turned = ours @ move[:3, :3].T + move[:3, 3]
    metre = 100 if unit == "cm" else 1
    assert np.abs(places[:, order] / metre - turned).max() < 1e-3


@pytest.mark.parametrize("exporter", [SmplxExporter, AmassExporter])
def test_parameters(exporter, request_, ours, upright, tmp_path):
    done = exporter().export(request_, tmp_path / "out")
    assert "body:anny" in done.omitted["shape of human"]
    data = np.load(tmp_path / "out" / "human.npz", allow_pickle=False)
    array = {
        name: torch.from_numpy(np.asarray(data[name], np.float32))
        for name in data
        if data[name].dtype.kind == "f"
    }
    if exporter is AmassExporter:
        assert data["mocap_framerate"] == request_.fps and array["poses"].shape[1] == 156
        turns, transl = array["poses"].unflatten(1, (52, 3)), array["trans"]
        parts = turns[:, 0], turns[:, 1:22], turns[:, 22:37], turns[:, 37:]
    else:
        body, left, right = (array[n].unflatten(1, (-1, 3)) for n in
                             ("body_pose", "left_hand_pose", "right_hand_pose"))  # fmt: skip
        parts, transl = (array["global_orient"], body, left, right), array["transl"]
    pose = BodyPose(*parts, transl, array["betas"])
    joints = request_.bodies["human"](pose).joints.numpy()
    scale = body_motion(request_, "human").scale  # AMASS has none, and the report says so
    if exporter is SmplxExporter:
        assert data["scale"] == pytest.approx(scale)
    else:
        assert ("scale of human" in done.omitted) == (scale != 1.0)
    joints = joints[:, :1] + scale * (joints - joints[:, :1])
    up = "z" if exporter is AmassExporter else "clip"
    move = upright(request_, up)
    assert np.abs(joints - ours @ move[:3, :3].T - move[:3, 3]).max() < 1e-3
