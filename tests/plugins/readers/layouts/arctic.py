"""A clip as a sequence of ARCTIC: images/, raw_seqs/ and meta/ of its data folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from layouts.common import save_image, save_json, save_mask

from hoigs.core.maths.rotations import matrices_to_axis_angle
from hoigs.core.values.clip import Clip

SUBJECT, SEQUENCE, OFFSET = "s05", "box_grab_01", 37
ORIGIN = np.array([0.03, -0.02, 0.05])  # of ARCTIC's canonical space, from the object's middle


def write(
    clip: Clip,
    root: Path,
    template: np.ndarray,
    *,
    view: int = 1,
    angles: Sequence[float] | None = None,
    dist: Sequence[float] = (0.0,) * 8,
    masks: bool = True,
) -> Path:
    """The folder of the view; betas of the clip must be zero, as a template stands for shape.

    Args:
        template: the subject's own zero-pose vertices. angles: of the object's top, radians, a
            frame; nothing turns without.
    """
    data = root / "arctic_data" / "data"
    images = data / "images" / SUBJECT / SEQUENCE / str(view)
    count, first = len(clip), clip.cameras[0]
    matrices = [c.world_to_camera.double().numpy() for c in clip.cameras]
    K = first.K.double().numpy()
    entry = {
        "gender": "female",
        "world2cam": [matrices[0].tolist()] * 8,
        "intris_mat": [K.tolist()] * 8,
        "image_size": [[first.width, first.height]] * 9,
        "ioi_offset": OFFSET,
    }
    save_json(data / "meta/misc.json", {SUBJECT: entry, "s01": {**entry, "gender": "male"}})
    poses, track = clip.bodies["human"].poses.to(torch.float64), clip.objects["object"]
    assert not poses.betas.any()
    raw = data / "raw_seqs" / SUBJECT
    raw.mkdir(parents=True, exist_ok=True)
    zeros = np.zeros((count, 3))
    smplx = {
        "transl": poses.transl.numpy(),
        "global_orient": poses.global_orient.numpy(),
        "body_pose": poses.body.flatten(1).numpy(),
        "jaw_pose": zeros, "leye_pose": zeros, "reye_pose": zeros,
        "left_hand_pose": poses.left_hand.flatten(1).numpy(),
        "right_hand_pose": poses.right_hand.flatten(1).numpy(),
    }  # fmt: skip
    np.save(raw / f"{SEQUENCE}.smplx.npy", smplx, allow_pickle=True)
    turns = track.rotations.double()
    places = track.translations.double() - turns @ torch.from_numpy(-ORIGIN)
    rows = np.c_[
        np.zeros(count) if angles is None else np.asarray(angles),
        matrices_to_axis_angle(turns).numpy(),
        1000 * places.numpy(),
    ]
    np.save(raw / f"{SEQUENCE}.object.npy", rows)
    if view == 0:
        ego = {
            "R_k_cam_np": np.stack(matrices)[:, :3, :3],
            "T_k_cam_np": np.stack(matrices)[:, :3, 3:],
            "intrinsics": K, "dist8": np.array(dist), "R0": np.eye(3), "T0": np.zeros((3, 1)),
        }  # fmt: skip
        np.save(raw / f"{SEQUENCE}.egocam.dist.npy", ego, allow_pickle=True)
    thing = data / "meta/object_vtemplates/box"
    thing.mkdir(parents=True, exist_ok=True)
    vertices = track.points.double().numpy() - ORIGIN
    write_obj(thing / "mesh.obj", 1000 * vertices)
    save_json(thing / "parts.json", (vertices[:, 1] > 0).astype(int).tolist())
    people = data / "meta/subject_vtemplates"
    people.mkdir(parents=True, exist_ok=True)
    write_obj(people / f"{SUBJECT}.obj", template)
    for i, frame in enumerate(clip):
        name = f"{i + OFFSET:05d}"
        # .jpg by name, as published; PNG inside, so that the comparison can be exact
        save_image(images / f"{name}.png", frame.image)
        (images / f"{name}.png").rename(images / f"{name}.jpg")
        room = data / "masks" / SUBJECT / SEQUENCE / str(view)
        for entity, mask in frame.masks.items() if masks else ():
            save_mask(room / entity / f"{name}.png", mask)
    return images


def write_obj(path: Path, vertices: np.ndarray) -> None:
    """Vertices, and faces that run backwards through them: a loader that reorders is found out."""
    lines = ["v " + " ".join(repr(float(x)) for x in v) for v in vertices]
    last = len(vertices)
    lines += [f"f {last - i} {last - i - 1} {last - i - 2}" for i in range(0, last - 2)]
    path.write_text("\n".join(lines) + "\n")
