"""reader:hold: a build folder of HOLD (Fan 2024): a still camera, hands and an object."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.system.unpickling import load_pickled_npy
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, ObjectTrack, uniform_test_split
from hoigs.core.values.tokens import EntityKind
from hoigs.plugins.readers.checked_files import Need, VideoPointsConfig, numbers, require_files
from hoigs.plugins.readers.lazy_frames import (
    LazyFrames,
    MaskFiles,
    PixelFiles,
    image_files,
    image_size,
    opened,
    video_moments,
)
from hoigs.plugins.readers.points import points_along_rays, rigid

LAYOUT = "a HOLD build folder"
MAKER = "`generator/scripts/build_dataset.py` of zc-alexfan/hold, or its released data, makes it"
VALUES = {"object": 50, "right": 150, "left": 250}  # of mask pixels
NEAREST, FARTHEST = 1.0, 4.0  # scene points start within these times the object's distance
NO_POSES = (
    "HOLD has MANO hands without a body or an arm, so they are not converted to SMPL-X poses; "
    "leave them out with `--set entities=[scene,object]`, or fit a body"
)
Array = np.ndarray


class HoldReader(ClipReader):
    """Frames, masks by value, cameras and the object's poses, in metres.

    The world is HOLD's before `scale_mat` shrinks it into the unit sphere. Entities are "object"
    and "hand_right", "hand_left", which have masks and no body poses. Poses of frames that SfM
    could not place were filled by HOLD's slerp; the data does not mark which ones.
    """

    Config: ClassVar = VideoPointsConfig
    config: VideoPointsConfig

    def matches(self, folder: Path) -> bool:
        build = _build(Path(folder))
        return (build / "data.npy").is_file() or (
            build.name == "build" and (build / "image").is_dir()
        )

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        require_files(folder, LAYOUT, [])
        build = _build(folder)
        images = image_files(build / "image")
        prefix = f"{build.relative_to(folder).as_posix()}/" if build != folder else ""
        needs = [Need.of(f"{prefix}data.npy", maker=MAKER)]
        if not images:
            needs.append(Need.of(f"{prefix}image/0000.png", maker=MAKER))
        needs += [Need.of(f"{prefix}mask/{p.stem}.png", maker=MAKER) for p in images]
        require_files(folder, LAYOUT, needs)
        data: Any = load_pickled_npy(build / "data.npy")
        where = str(build / "data.npy")
        if not isinstance(data, dict) or not {"cameras", "entities"} <= set(data):
            raise ClipError(f"{where}: expected a dictionary with cameras and entities")
        for key in ("cameras", "entities"):
            if not isinstance(data[key], dict):
                kind = type(data[key]).__name__
                raise ClipError(f"{where}: {key} is a {kind}, expected a dictionary")
        paths = [build / "mask" / f"{p.stem}.png" for p in images]
        _require_values(paths[0])
        cameras = _cameras(data["cameras"], images, where)
        hands = [h for h in ("right", "left") if h in data["entities"]]
        kinds: dict[str, EntityKind] = {f"hand_{h}": "human" for h in hands}
        kinds["object"] = "object"
        values = {n: VALUES[n.removeprefix("hand_")] for n in kinds}
        masks = {n: MaskFiles(paths, partial(_marked, value)) for n, value in values.items()}
        track = _object(data["entities"].get("object"), len(images), where)
        pixels = PixelFiles(images, masks=masks)
        store = LazyFrames(build, pixels, cameras, cache_mb=self.config.cache_mb)
        away = float(cameras[0].to_camera(track.translations)[:, 2].median())
        span = (NEAREST * away, FARTHEST * away)
        points, colors = points_along_rays(store, cameras, tuple(kinds), span, self.config.points)
        return Clip(
            name=(build.parent if build.name == "build" else build).resolve().name,
            store=store,
            cameras=cameras,
            moments=video_moments(range(len(images)), len(images)),
            kinds=kinds,
            objects={"object": track},
            points=points,
            point_colors=colors,
            split=uniform_test_split(len(images)),
            fps=self.config.fps,
            provenance={
                "reader": "reader:hold",
                "cameras": "world_mat of data.npy; scale_mat left out, so metres",
                "points": f"random, {span[0]:.2f} to {span[1]:.2f} m away",
                **{f"poses of hand_{h}": NO_POSES for h in hands},
            },
        )


def _build(folder: Path) -> Path:
    return folder / "build" if (folder / "build").is_dir() else folder


def _cameras(table: Any, images: Sequence[Path], where: str) -> list[Camera]:
    absent = [i for i in range(len(images)) if f"world_mat_{i}" not in table]
    if absent:
        raise ClipError(
            f"{where}: no world_mat_{absent[0]} ({len(absent)} of {len(images)} images have none)"
        )
    cameras = []
    for i, image in enumerate(images):
        name = f"world_mat_{i}"
        K, w2c = decomposed(numbers(table[name], f"{where}: {name}", -1, 4)[:3], f"{where}: {i}")
        width, height = image_size(image)
        lens, pose = torch.from_numpy(K).float(), torch.from_numpy(w2c).float()
        cameras.append(Camera(lens, pose, width, height))
    return cameras


def decomposed(
    projection: Float[Array, "3 4"], where: str
) -> tuple[Float[Array, "3 3"], Float[Array, "4 4"]]:
    """K and the rigid world-to-camera of P = K [R | t], up to P's scale and sign.

    Raises:
        ClipError: P has no inverse, or its pixels are skewed.
    """
    from scipy.linalg import rq

    if not np.isfinite(projection).all() or np.linalg.matrix_rank(projection[:, :3]) < 3:
        raise ClipError(f"{where}: the projection has no inverse")
    P = projection * np.sign(np.linalg.det(projection[:, :3]))
    K, R = rq(P[:, :3])
    signs = np.sign(np.diag(K))
    K, R = K * signs, signs[:, None] * R
    shift = np.linalg.solve(K, P[:, 3])
    K = K / K[2, 2]
    if abs(K[0, 1]) > 1e-3 * K[0, 0]:
        raise ClipError(f"{where}: pixels are skewed by {K[0, 1]:.3g}; a pinhole camera has none")
    K[0, 1] = 0.0
    return K, rigid(R, shift)


def _object(table: Any, frames: int, where: str) -> ObjectTrack:
    """x = R s N^-1 p + t: canonical points p, their normalisation N, the object's scale s."""
    keys = {"object_poses", "obj_scale", "norm_mat", "pts.cano"}
    found = set(table) if isinstance(table, dict) else set()
    if not keys <= found:
        raise ClipError(f"{where}: entities.object lacks {sorted(keys - found)}")
    poses = numbers(table["object_poses"], f"{where}: object_poses", frames, 6)
    cano = numbers(table["pts.cano"], f"{where}: pts.cano", -1, 3)
    norm = numbers(table["norm_mat"], f"{where}: norm_mat", 4, 4)
    if not len(cano):
        raise ClipError(f"{where}: pts.cano has no points")
    if np.linalg.matrix_rank(norm) < 4:
        raise ClipError(f"{where}: norm_mat has no inverse")
    back = np.linalg.inv(norm)
    scale = float(numbers(np.reshape(table["obj_scale"], -1)[:1], f"{where}: obj_scale", 1)[0])
    points = scale * (cano @ back[:3, :3].T + back[:3, 3])
    center = points.mean(0)
    rotations = axis_angle_to_matrices(torch.from_numpy(poses[:, :3]))
    places = torch.from_numpy(poses[:, 3:]) + rotations @ torch.from_numpy(center)
    about = torch.from_numpy(points - center).float()
    return ObjectTrack(
        points=about,
        colors=torch.full_like(about, 0.5),
        rotations=rotations.float(),
        translations=places.float(),
        observed=torch.ones(frames, dtype=torch.bool),
        provenance="HOLD's SfM on the masked object, aligned with the hand",
    )


def _require_values(path: Path) -> None:
    values = set(np.unique(np.asarray(opened(path).convert("L"))).tolist())
    if values - {0, *VALUES.values()}:
        raise ClipError(
            f"{path} has the values {sorted(values)[:8]}; HOLD's build writes 0, 50 (object), 150 "
            "(right hand) and 250 (left): these are a segmenter's own masks"
        )


def _marked(value: int, image: Image.Image) -> np.ndarray:
    return np.asarray(image.convert("L")) == value
