"""Toy model files in the layouts of SMPL+H and SMPL, cut from the toy SMPL-X."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from toy_smplx import toy_smplx

# of SMPL-X's 55 joints: without jaw and eyes; with one joint a hand, at the middle knuckle
SMPLH_JOINTS = (*range(22), *range(25, 55))
SMPL_JOINTS = (*range(22), 28, 43)


def _cut(joints: tuple[int, ...], block: bool) -> dict[str, np.ndarray]:
    file = toy_smplx()
    weights = file["weights"].copy()
    if block:  # all of a hand is bound to its one joint
        for kept, hand in ((28, range(25, 40)), (43, range(40, 55))):
            weights[:, kept] = weights[:, list(hand)].sum(1)
    # what hung on jaw and eyes hangs on the head
    weights[:, 15] += weights[:, 22:25].sum(1)
    directions = file["posedirs"].reshape(len(weights), 3, 54, 9)
    turned = [j - 1 for j in joints[1:]]
    table = np.zeros((2, len(joints)), dtype=np.int64)
    return {
        "v_template": file["v_template"],
        "f": file["f"],
        "weights": weights[:, joints],
        "J_regressor": file["J_regressor"][list(joints)],
        "posedirs": directions[:, :, turned].reshape(len(weights), 3, -1),
        "shapedirs": file["shapedirs"][:, :, :10],
        "kintree_table": table,
    }


def write_smplh(path: Path, mean_hands: bool = True) -> Path:
    file = _cut(SMPLH_JOINTS, block=False)
    if mean_hands:
        file |= {k: toy_smplx()[k] for k in ("hands_meanl", "hands_meanr")}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **file)
    return path


def write_smpl(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **_cut(SMPL_JOINTS, block=True))
    return path
