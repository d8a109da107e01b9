"""Model files in the layouts of SMPL, SMPL+H and SMPL-X with the built-in body's shape and joints.

So a pose of the built-in clip means the same on them, which the real, licensed files could not do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hoigs.plugins.bodies.anny import AnnyBody

VERTICES = 240  # of the body's, enough to tell joints and shape


def write_model(path: Path, family: str) -> Path:
    """family: "smpl" (24 joints), "smplh" (52) or "smplx" (55, face joints at the head)."""
    body = AnnyBody()
    rows = np.random.default_rng(0).permutation(len(body.template))[:VERTICES]
    template = body.template.double().numpy()[rows]
    shapes = body.shape_directions.double().numpy()[:, rows]  # [B, V, 3]
    weights = body.skinning_weights.double().numpy()[rows]
    joints = body.joints.double().numpy()
    moves = body.joint_shape_directions.double().numpy()
    # weights of the vertices that give each joint, whatever the shape: the smallest that fit
    known = np.concatenate((template.T, shapes.transpose(0, 2, 1).reshape(-1, len(rows))))
    wanted = np.concatenate((joints.T, moves.transpose(0, 2, 1).reshape(-1, len(joints))))
    regressor = (np.linalg.pinv(known) @ wanted).T
    order = list(range(52))
    if family == "smpl":
        order = [*range(22), 25, 40]
        for kept, hand in ((25, slice(22, 37)), (40, slice(37, 52))):
            weights[:, kept] = weights[:, hand].sum(1)
    elif family == "smplx":
        order = [*range(22), 15, 15, 15, *range(22, 52)]
    count = len(order)
    chosen = weights[:, order]
    if family == "smplx":
        chosen[:, 22:25] = 0  # jaw and eyes carry nothing of their own
    parents = {
        "smplx": (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15,
                  15, *(p for w, s in ((20, 25), (21, 40)) for f in range(5)
                        for p in (w, s + 3 * f, s + 3 * f + 1)))
    }.get(family, (-1, *[0] * (count - 1)))  # fmt: skip
    table = np.array([[2**32 - 1, *parents[1:]], range(count)], dtype=np.int64)
    path.parent.mkdir(parents=True, exist_ok=True)
    width = 20 if family == "smplx" else 10  # 10 of shape and 10 of expression
    directions = np.zeros((len(rows), 3, width))
    directions[:, :, :10] = shapes.transpose(1, 2, 0)[:, :, :10]
    hands = np.random.default_rng(1).normal(scale=0.2, size=(2, 45))
    np.savez(
        path,
        v_template=template,
        f=np.array([(i, i + 1, i + 2) for i in range(len(rows) - 2)]),
        weights=chosen,
        J_regressor=regressor[order],
        posedirs=np.zeros((len(rows), 3, 9 * (count - 1))),
        shapedirs=directions,
        kintree_table=table,
        **({} if family == "smpl" else {"hands_meanl": hands[0], "hands_meanr": hands[1]}),
    )
    return path
