"""What a run keeps of its clip, so that it can be drawn where the clip is gone: all but pixels."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.clip_folder.format import body_key
from hoigs.core.errors import ClipError
from hoigs.core.system.files import write_whole
from hoigs.core.system.npz import load_arrays
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.world import World

FORMAT, VERSION = "hoigs-kept-clip", 2
READABLE = (1, VERSION)  # as in clips, bodies of version 1 have keys of their own
POSE = ("global_orient", "body", "left_hand", "right_hand", "transl", "betas")
OBJECT = ("points", "colors", "rotations", "translations", "observed", "moving")
ADVICE = "remove it and name the clip, or train again"


class NoPixels(FrameStore):
    """Stands in for the frames of a deleted clip; reading pixels raises ClipError."""

    def __init__(self, run: Path) -> None:
        self.run = run

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        raise self._gone(position)

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        raise self._gone(position)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        raise self._gone(position)

    def _gone(self, position: int) -> ClipError:
        return ClipError(
            f"{self.run} keeps cameras and poses of its clip, but not the pixels of frame "
            f"{position}, and the clip of this run is not there; name it with --clip"
        )


def save_kept(clip: Clip, path: Path) -> None:
    """Write cameras, times, poses, object tracks, points and the world of a clip.

    Pixels and held-out views are left out, and the colours of points: Gaussians have their own.
    """
    arrays: dict[str, np.ndarray] = {
        "points": _array(clip.points),
        "times": np.array([float(m.time) for m in clip.moments]),
        "indices": np.array([m.index for m in clip.moments], np.float64),
        "K": np.stack([_array(c.K) for c in clip.cameras]),
        "world_to_camera": np.stack([_array(c.world_to_camera) for c in clip.cameras]),
        "sizes": np.array([(c.width, c.height) for c in clip.cameras], np.float64),
    }
    bodies, objects = {}, {}
    for i, (name, body) in enumerate(clip.bodies.items()):
        arrays |= {f"bodies/{i}/{f}": _array(getattr(body.poses, f)) for f in POSE}
        if body.template is not None:
            arrays[f"bodies/{i}/template"] = _array(body.template)
        bodies[name] = {
            "model": body.model,
            "gender": body.gender,
            "provenance": body.provenance,
            "hands": body.poses.hand_pose_convention,
        }
    for i, (name, track) in enumerate(clip.objects.items()):
        values = {f: getattr(track, f) for f in OBJECT}
        arrays |= {f"objects/{i}/{f}": _array(v) for f, v in values.items() if v is not None}
        objects[name] = {
            "provenance": track.provenance,
            "times": None if track.times is None else list(track.times),
            "rotation_known": track.rotation_known,
        }
    header = {
        "format": FORMAT,
        "version": VERSION,
        "name": clip.name,
        "fps": clip.fps,
        "split": {use: [int(i) for i in rows] for use, rows in clip.split.items()},
        "kinds": dict(clip.kinds),
        "depth_kind": clip.depth_kind,
        "provenance": dict(clip.provenance),
        "world": clip.world.to_dict(),
        "bodies": bodies,
        "objects": objects,
    }
    data = io.BytesIO()
    np.savez_compressed(data, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    write_whole(path, data.getvalue())


def load_kept(path: Path) -> Clip:
    """The clip that `save_kept` wrote, whose frames have no pixels (`NoPixels`).

    Raises:
        ClipError: the file is damaged, or of another version.
    """
    try:
        arrays = load_arrays(path)
        header = json.loads(str(arrays["header"]))
        if header["format"] != FORMAT or header["version"] not in READABLE:
            raise ValueError(f"{header['format']} version {header['version']}, expected {VERSION}")
        return _clip(header, arrays, path.parent)
    except (OSError, ValueError, KeyError, TypeError, IndexError, RuntimeError) as error:
        raise ClipError(f"{path}: damaged ({type(error).__name__}: {error}); {ADVICE}") from error


def _clip(header: dict[str, Any], arrays: Mapping[str, np.ndarray], run: Path) -> Clip:
    bodies, objects = {}, {}
    for i, (name, said) in enumerate(header["bodies"].items()):
        found = _below(arrays, f"bodies/{i}/")
        template = found.pop("template", None)
        poses = BodyPose(**found, hand_pose_convention=said["hands"])
        model = body_key(said["model"], header["version"])
        bodies[name] = BodyTrack(model, poses, said["provenance"], said["gender"], template)
    for i, (name, said) in enumerate(header["objects"].items()):
        times = None if said["times"] is None else tuple(said["times"])
        objects[name] = ObjectTrack(
            **_below(arrays, f"objects/{i}/"), provenance=said["provenance"], times=times,
            rotation_known=said["rotation_known"],
        )  # fmt: skip
    indices = arrays["indices"].astype(int).tolist()
    moments = []
    for row, (time, index) in enumerate(zip(arrays["times"].tolist(), indices, strict=True)):
        poses_then = {
            n: t.poses.frame(row if len(t.poses.transl) == len(indices) else index)
            for n, t in bodies.items()
        }
        moments.append(Moment(time, index, poses_then))
    views = zip(
        torch.from_numpy(arrays["K"]), torch.from_numpy(arrays["world_to_camera"]),
        arrays["sizes"].astype(int).tolist(), strict=True,
    )  # fmt: skip
    points = torch.from_numpy(arrays["points"])
    return Clip(
        name=header["name"],
        store=NoPixels(run),
        cameras=[Camera(K, view, width, height) for K, view, (width, height) in views],
        moments=moments,
        points=points,
        point_colors=torch.full_like(points, 0.5),
        split=header["split"],
        kinds=header["kinds"],
        bodies=bodies,
        objects=objects,
        fps=header["fps"],
        depth_kind=header["depth_kind"],
        provenance=header["provenance"],
        world=World.from_dict(header["world"]),
    )


def _below(arrays: Mapping[str, np.ndarray], place: str) -> dict[str, Any]:
    """The arrays of a folder within the npz, as tensors."""
    return {
        name.removeprefix(place): torch.from_numpy(values)
        for name, values in arrays.items()
        if name.startswith(place)
    }


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()
