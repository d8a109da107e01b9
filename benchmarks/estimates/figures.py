"""How far a prepared clip is from the truth: the object's rotation, place and shape, the body."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

World = tuple[np.ndarray, np.ndarray]  # rotation and shift from the clip's world to the true one


def object_figures(made: Any, truth: Any, truth_folder: Path, world: World) -> dict[str, Any]:
    """Rotation, place and shape of the object; degrees and millimetres."""
    from hoigs.core.system.npz import load_arrays

    arrays = load_arrays(truth_folder / "truth.npz")
    track = made.objects["object"]
    rotations = world[0] @ track.rotations.double().numpy()
    true_rotations = arrays["object_rotations"]
    points = track.points.double().numpy()
    middle = (np.quantile(points, 0.01, axis=0) + np.quantile(points, 0.99, axis=0)) / 2
    places = track.translations.double().numpy() @ world[0].T + world[1] + rotations @ middle
    seen = truth.objects["object"].observed.numpy()
    first = int(np.flatnonzero(seen)[0])
    turned = rotations @ rotations[first].T
    true_turned = true_rotations @ true_rotations[first].T
    off = angles(turned, true_turned)[seen]
    offset = mean_rotation(np.swapaxes(rotations, 1, 2) @ true_rotations)
    best = angles(rotations @ offset, true_rotations)[seen]
    error = places - arrays["object_translations"]
    centers = np.stack([c.center.numpy() for c in truth.cameras]).astype(float)
    view = arrays["object_translations"] - centers
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    along = (error * view).sum(-1)[seen]
    across = np.linalg.norm(error - (error * view).sum(-1, keepdims=True) * view, axis=-1)[seen]
    place = np.linalg.norm(error, axis=-1)[seen]
    truth_points = surface(arrays["object_vertices"], arrays["object_faces"])
    aligned = (points - middle) @ offset
    distance, scale = chamfer(aligned, truth_points)
    turn = np.median(angles(true_turned, np.eye(3)))
    return {
        "rotation_deg": _spread(off), "rotation_best_frame_deg": _spread(best),
        "rotation_none_at_all_deg": round(float(turn), 2),
        "place_mm": _spread(1000 * place, mean=True),
        "place_along_view_mm": round(float(1000 * np.abs(along).mean()), 1),
        "place_across_view_mm": round(float(1000 * across.mean()), 1),
        "chamfer_mm": round(1000 * distance, 1), "size_ratio": round(scale, 3),
        "size_mm": [round(float(v)) for v in 1000 * np.ptp(points, axis=0)],
    }  # fmt: skip


def body_figures(made: Any, truth: Any, body: Any, world: World) -> dict[str, Any]:
    """Joints after aligning the pelvis, wrists in the world, and accelerations of joints."""
    one, two = _joints(body, made) @ world[0].T + world[1], _joints(body, truth)
    off = np.linalg.norm((one - one[:, :1]) - (two - two[:, :1]), axis=-1)
    wrists = np.linalg.norm(one - two, axis=-1)[:, [20, 21]]
    bend = np.diff(one - two, n=2, axis=0) * truth.fps**2
    return {
        "root_aligned_joints_mm": round(float(1000 * off.mean()), 1),
        "joints_mm": round(float(1000 * np.linalg.norm(one - two, axis=-1).mean()), 1),
        "wrists_mm": round(float(1000 * wrists.mean()), 1),
        "acceleration_error_m_s2": round(float(np.linalg.norm(bend, axis=-1).mean()), 2),
    }


SEEN_JOINTS = [16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8]  # that have landmarks, shoulders first


def body_within(made: Any, truth: Any, body: Any, folder: Path) -> dict[str, Any]:
    """Whether what the clip's report says of the body holds."""
    seen = []
    for clip in (made, truth):
        view = np.stack([c.world_to_camera.double().numpy() for c in clip.cameras])
        at = _joints(body, clip)[:, SEEN_JOINTS] @ np.swapaxes(view[:, :3, :3], 1, 2)
        seen.append(at + view[:, None, :3, 3])
    report = json.loads((folder / "report.json").read_text())
    return within_figures(*seen, report["bodies_within"]["human"])


def within_figures(joints: np.ndarray, true: np.ndarray, within: dict[str, Any]) -> dict[str, Any]:
    """Millimetres between joints and true ones, [F, J, 3] along the camera's axes with the
    shoulders first, what the report says of them, and the share of the frames in which it holds.

    Args:
        true: NaN where it does not count. within: the report's `bodies_within` of the person.
    """
    both = np.isfinite(true[:, :2]).all((1, 2))
    about, true_about = (j - j[:, :2].mean(1, keepdims=True) for j in (joints, true))
    found = {
        "joints": np.nanmean(np.linalg.norm(about - true_about, axis=-1)[both], -1),
        "distance": np.abs((joints - true)[both][:, :2, 2].mean(-1)),
    }
    figures = {}
    for name, off in found.items():
        said = np.array(within[name], float)[both]
        figures |= {
            f"{name}_off_mm": round(float(1000 * np.median(off))),
            f"{name}_said_mm": round(float(1000 * np.median(said))),
            f"{name}_within": round(float((off < said).mean()), 2),
        }
    return figures


def _joints(body: Any, clip: Any) -> np.ndarray:
    """The joints of body, without those of the hands."""
    from hoigs.preparation.body.mask_fit import posed

    joints = [j.double().numpy() for _, j in posed(body, clip.bodies["human"].poses)]
    return np.stack(joints)[:, :22]


TRUE_CONTACT, CONTACT = (
    0.01,
    0.03,
)  # metres from the skin of a hand to the surface, and to its points


def contact_figures(made: Any, truth: Any, truth_folder: Path, body: Any) -> dict[str, Any]:
    """Which hand touches the object in which frame: precision, recall and F1; and, where one truly
    does, how far apart both are."""
    from hoigs.core.interfaces.body import LEFT_HAND_PART, RIGHT_HAND_PART
    from hoigs.core.system.npz import load_arrays

    arrays, track = load_arrays(truth_folder / "truth.npz"), made.objects["object"]
    true_points = surface(arrays["object_vertices"], arrays["object_faces"])
    points = track.points.double().numpy()
    hands = [body.vertex_parts == part for part in (LEFT_HAND_PART, RIGHT_HAND_PART)]
    found = _hand_distances(
        made, body, hands, points, track.rotations.double().numpy(),
        track.translations.double().numpy(),
    )  # fmt: skip
    true = _hand_distances(
        truth, body, hands, true_points, arrays["object_rotations"], arrays["object_translations"]
    )
    touching, touched = found < CONTACT, true < TRUE_CONTACT
    both = int((touching & touched).sum())
    precision, recall = both / max(1, int(touching.sum())), both / max(1, int(touched.sum()))
    if not touched.any():
        return {"contact": "not computed: no hand touches the object"}
    return {
        "contact": {
            "precision": round(precision, 3), "recall": round(recall, 3),
            "f1": round(2 * both / max(1, int(touching.sum()) + int(touched.sum())), 3),
            "apart_mm": round(float(1000 * np.median(found[touched])), 1),
            "hands_in_frames": int(touched.sum()),
        }
    }  # fmt: skip


def _hand_distances(
    clip: Any, body: Any, hands: Any, points: np.ndarray, rotations: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Metres from each hand to the object in each frame, [F, 2]."""
    from scipy.spatial import cKDTree

    from hoigs.preparation.body.mask_fit import posed

    tree, found = cKDTree(points), []
    for i, (vertices, _) in enumerate(posed(body, clip.bodies["human"].poses)):
        local = (vertices.double().numpy() - places[i]) @ rotations[i]  # into the object's frame
        found.append([tree.query(local[hand.numpy()])[0].min() for hand in hands])
    return np.array(found)


def camera_motion(made: Any, truth: Any) -> World:
    """The rigid motion that takes a clip's cameras nearest to the true ones. It has no scale: an
    error of the world's scale stays in the figures."""
    ours, true = (
        np.stack([c.world_to_camera.double().numpy() for c in clip.cameras])
        for clip in (made, truth)
    )
    turn = mean_rotation(np.swapaxes(true[:, :3, :3], 1, 2) @ ours[:, :3, :3])
    centers, target = (-np.einsum("fji,fj->fi", m[:, :3, :3], m[:, :3, 3]) for m in (ours, true))
    return turn, (target - centers @ turn.T).mean(0)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between rotations."""
    cosine = (np.einsum("...ij,...ij->...", a, b) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """The rotation nearest to all (chordal distance)."""
    u, _, vt = np.linalg.svd(rotations.sum(0))
    return u @ np.diag((1, 1, np.linalg.det(u @ vt))) @ vt


def surface(vertices: np.ndarray, faces: np.ndarray, count: int = 6000) -> np.ndarray:
    """Evenly spread random points of a mesh."""
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def chamfer(points: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Mean of the mean distances both ways after rigid ICP from 25 starts, and the ratio of sizes
    (root mean square distances from the middle)."""
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    points, true = points - points.mean(0), true - true.mean(0)
    rng = np.random.default_rng(0)
    few = points[rng.permutation(len(points))[:1500]]
    tree, best, result = cKDTree(true), np.inf, (np.eye(3), np.zeros(3))
    starts = [np.eye(3), *Rotation.create_group("O").as_matrix()]
    for start in starts:
        turn, shift = start, np.zeros(3)
        for _ in range(15):
            moved = few @ turn.T + shift
            distance, at = tree.query(moved)
            target = true[at]
            a, b = few - few.mean(0), target - target.mean(0)
            turn = mean_rotation((b.T @ a)[None])
            shift = target.mean(0) - turn @ few.mean(0)
        back, _ = cKDTree(moved).query(true[::4])
        both = (distance.mean() + back.mean()) / 2
        if both < best:
            best, result = both, (turn, shift)
    moved = points @ result[0].T + result[1]
    both = (tree.query(moved)[0].mean() + cKDTree(moved).query(true)[0].mean()) / 2
    sizes = [np.sqrt((p**2).sum(-1).mean()) for p in (points, true)]
    return float(both), float(sizes[0] / sizes[1])


def _spread(values: np.ndarray, *, mean: bool = False) -> dict[str, float]:
    middle = ("mean", values.mean()) if mean else ("median", np.median(values))
    found = (middle, ("p95", np.quantile(values, 0.95)), ("worst", values.max()))
    return {name: round(float(value), 2) for name, value in found}


def draw_masks(made: Any, file: Path) -> None:
    """Eight frames with the outlines of people (green), and of objects (magenta, yellow)."""
    colors = {"human": [(0, 255, 0)], "object": [(255, 0, 255), (255, 220, 0)]}
    shown = [(n, colors[kind].pop(0)) for n, kind in made.kinds.items() if colors.get(kind)]
    tiles = []
    for i in np.linspace(0, len(made) - 1, 8).astype(int):
        image = made[int(i)].image.numpy().copy()
        for name, color in shown:
            mask = made[int(i)].masks[name].numpy()
            image[ndimage.binary_dilation(mask, iterations=2) & ~mask] = color
        tiles.append(image)
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = [np.concatenate(tiles[k : k + 4], 1) for k in (0, 4)]
    Image.fromarray(np.concatenate(rows)).save(file)
