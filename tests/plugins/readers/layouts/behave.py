"""A clip as a sequence of BEHAVE, with calibs/ and objects/ beside sequences/."""

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from layouts.changed import in_camera_world
from layouts.common import save_image, save_json, save_mask

from hoigs.core.maths.rotations import matrices_to_axis_angle
from hoigs.core.values.clip import Clip

NAME = "Date03_Sub04_boxmedium"
OFFSET = np.array([0.4, -0.2, 1.3])  # scans stand anywhere
KINECT_2 = {"rotation": [0, 0, 1, 0, 1, 0, -1, 0, 0], "translation": [2.0, 0.1, 1.5]}


def write(
    clip: Clip,
    root: Path,
    pelvis: torch.Tensor,
    *,
    distortion: Sequence[float] = (0.0,) * 8,
    category: str = "boxmedium",
    arrays: Sequence[int] | None = None,
    kinects: Sequence[int] = (1, 2),
    masks: bool = True,
    suffix: str = "png",
) -> tuple[Path, Clip]:
    """The sequence's folder, and the clip as it stands there: in the world of Kinect 1.

    Args:
        clip: of a camera that stands still. pelvis: J_0(betas) of the body.
        arrays: registered frames, written as 30-fps arrays; None writes a fit into each frame.
    """
    there = in_camera_world(clip, pelvis)
    folder = root / "sequences" / NAME
    save_json(
        folder / "info.json",
        {"config": "../../calibs/Date03/config", "intrinsic": "../../calibs/intrinsics",
         "cat": category, "gender": "male", "empty": None, "kinects": [0, 1, 2, 3], "beta": None},
    )  # fmt: skip
    calibs = root / "calibs"
    camera = there.cameras[0]
    K, eye = camera.K.double(), {"rotation": np.eye(3).ravel().tolist(), "translation": [0, 0, 0]}
    # OpenCV puts the centre of the top-left pixel at (0, 0)
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5))
    color = {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx,
             "cy": cy, "opencv": [fx, fy, cx, cy, *distortion]}  # fmt: skip
    for k in kinects:
        save_json(calibs / "Date03/config" / str(k) / "config.json", eye if k == 1 else KINECT_2)
        save_json(calibs / "intrinsics" / str(k) / "calibration.json", {"color": color})
    offset = write_template(root / "objects" / category, category, there.objects["object"].points)
    fits = _fits(there, offset)
    names = [f"t{3 + i / 30:08.3f}" for i in range(len(there))]
    for i, name in enumerate(names):
        frame = there[i]
        for k in kinects:
            at = folder / name / f"k{k}"
            save_image(at.with_name(f"k{k}.color.{suffix}"), frame.image)
            assert frame.depth is not None
            millimetres = (1000 * frame.depth).round().numpy().astype(np.uint16)
            save_image(at.with_name(f"k{k}.depth.png"), millimetres)
            if masks:
                save_mask(at.with_name(f"k{k}.person_mask.png"), frame.masks["human"])
                save_mask(at.with_name(f"k{k}.obj_rend_mask.png"), frame.masks["object"])
        if arrays is None:
            _save_fits(folder / name, category, fits, i)
    if arrays is not None:
        rows = list(arrays)
        times = np.array([names[i] for i in rows])
        person = {k: fits[k][rows] for k in ("poses", "trans", "betas")}
        thing = {"angles": fits["angles"][rows], "trans": fits["at"][rows]}
        np.savez(folder / "smpl_fit_all.npz", **person, frame_times=times, gender="male")
        np.savez(folder / "object_fit_all.npz", **thing, frame_times=times)
    return folder, there


def write_template(folder: Path, name: str, points: torch.Tensor) -> np.ndarray:
    """The simplified mesh, standing anywhere; returns the mean of its vertices from the object's
    centre. One vertex is there twice, as scans have them: merged, the mean would move."""
    import trimesh

    hull = trimesh.PointCloud(points.double().numpy()).convex_hull
    vertices = np.concatenate((hull.vertices, np.repeat(hull.vertices[:1], 5, 0)))
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(hull.faces)}", "property list uchar int vertex_indices"]
    lines += ["end_header", *(" ".join(map(repr, map(float, v + OFFSET))) for v in vertices)]
    lines += [" ".join(map(str, (3, *f))) for f in hull.faces]
    (folder / f"{name}_f1000.ply").write_text("\n".join(lines) + "\n")
    return vertices.mean(0)


def _fits(clip: Clip, offset: np.ndarray) -> dict[str, np.ndarray]:
    poses, track = clip.bodies["human"].poses.to(torch.float64), clip.objects["object"]
    turns = track.rotations.double()
    places = track.translations.double() + turns @ torch.from_numpy(offset)
    return {
        "poses": poses.rotations.flatten(-2).numpy(),
        "trans": poses.transl.numpy(),
        "betas": poses.betas.expand(len(clip), -1).numpy(),
        "angles": matrices_to_axis_angle(turns).numpy(),
        "at": places.numpy(),
    }


def _save_fits(frame: Path, category: str, fits: dict[str, np.ndarray], i: int) -> None:
    name = "sports ball" if "ball" in category else category
    person: dict[str, Any] = {
        "pose": fits["poses"][i], "betas": fits["betas"][i], "trans": fits["trans"][i]
    }  # fmt: skip
    thing = {"angle": fits["angles"][i], "trans": fits["at"][i]}
    for path, table in (
        (frame / "person/fit02/person_fit.pkl", person),
        (frame / name / "fit01" / f"{name}_fit.pkl", thing),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(table))


def edit(path: Path, **changes: Any) -> None:
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **changes}))
