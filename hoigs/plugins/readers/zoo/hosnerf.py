"""reader:hosnerf: scenes of HOSNeRF (Liu 2023), one person who handles objects, a moving camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from pydantic import Field
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.model.smpl_params import betas_of_joints, pose_from_smpl
from hoigs.core.system.npz import load_array
from hoigs.core.system.unpickling import load_pickle
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, OverStore, uniform_test_split
from hoigs.core.values.lens import Lens
from hoigs.core.values.tokens import EntityKind
from hoigs.plugins.readers.checked_files import (
    Need,
    VideoPointsConfig,
    entry,
    load_json,
    numbers,
    require_files,
)
from hoigs.plugins.readers.lazy_frames import (
    LazyFrames,
    MaskFiles,
    PixelFiles,
    image_files,
    image_size,
    video_moments,
)
from hoigs.plugins.readers.points import body_model, checked_rotation, points_along_rays, rigid

LAYOUT = "a HOSNeRF scene"
AUTHORS = "it is in the authors' download (github.com/TencentARC/HOSNeRF)"
OBJECT_MASKS = "object_masks"  # ours: HOSNeRF has one mask for person and object together
ANOTHER_PERSON = 0.1  # metres between zero-pose joints
SAME_SCALE, SAME_VIEW = 0.1, np.radians(5.0)
NO_POSES = (
    "no poses without an SMPL model, which gives shape and position: "
    "--reader hosnerf --reader-set smpl=SMPL_NEUTRAL.npz"
)
Array = np.ndarray


class HosnerfConfig(VideoPointsConfig):
    """Settings of reader:hosnerf."""

    smpl: Path | None = Field(
        default=None, description="your SMPL model as .npz (body:smpl); without it, no body poses"
    )


class HosnerfReader(ClipReader):
    """Cameras, masks and SMPL poses, matched by frame name, in metres.

    The world is COLMAP's, scaled to the SMPL body (`smpl_to_world` contains the scale). Masks
    are of person and object together: entity "human"; put masks of the object alone into
    `object_masks/` to have both. There is neither a point cloud nor depth: scene points start
    along the rays, between the bounds of poses_bounds.npy.
    """

    Config: ClassVar = HosnerfConfig
    config: HosnerfConfig

    def matches(self, folder: Path) -> bool:
        own = ("cameras.pkl", "mesh_infos.pkl", "canonical_joints.pkl")
        return any((Path(folder) / name).is_file() for name in own)

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        images = image_files(folder / "images")
        mask_folders = ["masks", *([OBJECT_MASKS] if (folder / OBJECT_MASKS).is_dir() else [])]
        makers = {"masks": AUTHORS, OBJECT_MASKS: "your segmenter makes it; or remove the folder"}
        names = ("cameras.pkl", "mesh_infos.pkl", "poses_bounds.npy")
        needs = [Need.of(name, maker=AUTHORS) for name in names]
        if not images:
            needs.append(Need.of("images/00000.png", "images/00000.jpg", maker=AUTHORS))
        needs += [
            Need.of(f"{mask_folder}/{path.stem}.png", maker=makers[mask_folder])
            for mask_folder in mask_folders
            for path in images
        ]
        require_files(folder, LAYOUT, needs)
        rig = _read_rig(folder, images)
        kinds: dict[str, EntityKind] = {"human": "human"}
        masks = {"human": MaskFiles([folder / "masks" / f"{p.stem}.png" for p in images], _any)}
        if OBJECT_MASKS in mask_folders:
            kinds["object"] = "object"
            own = [folder / OBJECT_MASKS / f"{p.stem}.png" for p in images]
            masks["object"] = MaskFiles(own, _any)
        cameras = [lens.camera(w2c) for lens, w2c in zip(rig.lenses, rig.world_to_camera)]
        pixels, cache = PixelFiles(images, masks=masks), self.config.cache_mb
        store: FrameStore = LazyFrames(folder, pixels, cameras, lenses=rig.lenses, cache_mb=cache)
        if "object" in kinds:
            store = _ObjectRemoved(store)
        bodies = {}
        if self.config.smpl is not None:
            bodies["human"] = _body(folder, images, rig, self.config.smpl)
        count = self.config.points
        points, colors = points_along_rays(store, cameras, tuple(kinds), rig.span, count)
        provenance: dict[str, Any] = {
            "reader": "reader:hosnerf",
            "cameras": f"cameras.pkl, by name; COLMAP's world divided by {rig.scale:.6g}: metres",
            "points": "random, along rays between the bounds of poses_bounds.npy",
        }
        if not bodies:
            provenance["poses of human"] = NO_POSES
        states = folder / "transitions_times.json"
        if states.is_file():
            provenance["transitions"] = _transitions(states)
        return Clip(
            name=folder.resolve().name, store=store, cameras=cameras,
            moments=video_moments(range(len(images)), len(images), bodies), kinds=kinds,
            bodies=bodies, points=points, point_colors=colors, split=published_split(len(images)),
            fps=self.config.fps, provenance=provenance,
        )  # fmt: skip


def _transitions(path: Path) -> list[float]:
    content = load_json(path)
    rows = content.values() if isinstance(content, dict) else [content]
    times = [entry(row, "time", str(path)) for row in rows]
    return [float(numbers(time, f"{path}: time", 1, flat=True)[0]) for time in times]


def published_split(count: int) -> dict[str, list[int]]:
    """HOSNeRF's own: every (N // 16)-th frame from the first on, 16 of them, is for tests.

    So frame 0 is a test frame, before all training frames, and with N = 300 the last 29 frames are
    all for training. Clips under 32 frames, of which the rule leaves nothing that moves, are split
    evenly.
    """
    if count < 32:
        return uniform_test_split(count)
    test = list(range(0, count, count // 16))[:16]
    return {"train": sorted(set(range(count)) - set(test)), "test": test}


@dataclass(frozen=True)
class _Rig:
    """Per frame: lens, world-to-camera (metres), and SMPL's space to the world (similarity)."""

    lenses: list[Lens]
    world_to_camera: list[Float[Array, "4 4"]]
    smpl_to_world: Float[Array, "F 4 4"]
    scale: float  # COLMAP units in a metre
    span: tuple[float, float]  # nearest and farthest depth, metres


def _read_rig(folder: Path, images: Sequence[Path]) -> _Rig:
    table = _by_name(folder / "cameras.pkl", images)
    path = folder / "cameras.pkl"
    to_world = np.stack([_matrix(e, "smpl_to_world", f"{path}: {n}") for n, e in table.items()])
    scales = np.cbrt(np.linalg.det(to_world[:, :3, :3]))
    scale = float(np.median(scales))
    if not (scales > 0).all() or np.abs(scales / scale - 1).max() > SAME_SCALE:
        raise ClipError(
            f"{folder / 'cameras.pkl'}: smpl_to_world scales by {scales.min():.3g} to "
            f"{scales.max():.3g}; one scene has one scale"
        )
    lenses, poses = [], []
    for (name, row), similar, own, image in zip(table.items(), to_world, scales, images):
        where = f"{path}: {name}"
        to_camera = _matrix(row, "smpl_to_camera", where)
        turn = checked_rotation(to_camera[:3, :3], f"{where}: smpl_to_camera")
        from_smpl = checked_rotation(similar[:3, :3] / own, f"{where}: smpl_to_world")
        center = (similar[:3, :3] @ (-turn.T @ to_camera[:3, 3]) + similar[:3, 3]) / scale
        rotation = turn @ from_smpl.T
        poses.append(rigid(rotation, -rotation @ center))
        K = numbers(entry(row, "intrinsics", where), f"{where}: intrinsics", -1, -1)
        bent = numbers(row.get("distortions", ()), f"{where}: distortions", flat=True)
        K = numbers(K[:3, :3], f"{where}: intrinsics", 3, 3)
        lenses.append(Lens.opencv(K, bent.tolist(), *image_size(image)))
    bounds = _bounds(folder / "poses_bounds.npy", images, poses)
    span = (float(np.quantile(bounds[:, 0], 0.05)), float(np.quantile(bounds[:, 1], 0.95)))
    return _Rig(lenses, poses, to_world, scale, (span[0] / scale, span[1] / scale))


def _by_name(path: Path, images: Sequence[Path]) -> dict[str, Mapping[str, Any]]:
    """A pickled dictionary in the order of the images, whatever its own order."""
    table = load_pickle(path)
    if not isinstance(table, dict):
        raise ClipError(f"{path} holds a {type(table).__name__}, expected a dictionary by frame")
    absent = [p.stem for p in images if p.stem not in table and p.name not in table]
    if absent:
        shown = ", ".join(absent[:8]) + (", …" if len(absent) > 8 else "")
        raise ClipError(
            f"{path} has no entry for {len(absent)} of {len(images)} images ({shown}); it has "
            f"{', '.join(map(str, list(table)[:3]))}, …: names must be those of the images"
        )
    return {p.stem: table[p.stem if p.stem in table else p.name] for p in images}


def _bounds(
    path: Path, images: Sequence[Path], world_to_camera: Sequence[Array]
) -> Float[Array, "F 2"]:
    """Near and far in COLMAP's unit, by image; its rows follow the sorted names.

    Raises:
        ClipError: the number of rows is wrong, or rows are rotated differently from the cameras,
            as they are if rows and images are paired wrongly.
    """
    try:
        found = load_array(path)
    except (OSError, ValueError, OverflowError) as error:
        raise ClipError(f"{path} cannot be read ({error}); write it again") from error
    rows = numbers(found, f"{path}, one row for each image", len(images), 17)
    order = np.argsort(np.argsort([p.name for p in images]))  # the image's place by plain sorting
    rows = rows[order]
    # columns of LLFF are down, right, back; OpenCV's are right, down, forward
    llff = rows[:, :15].reshape(-1, 3, 5)[:, :, :3]
    turns = np.stack((llff[:, :, 1], llff[:, :, 0], -llff[:, :, 2]), -1)
    ours = np.stack([w2c[:3, :3].T for w2c in world_to_camera])
    since = [np.swapaxes(r[:1], 1, 2) @ r for r in (turns, ours)]
    cosine = (np.einsum("fab,fab->f", *since) - 1) / 2
    off = np.flatnonzero(np.arccos(np.clip(cosine, -1, 1)) > SAME_VIEW)
    if len(off):
        raise ClipError(
            f"{path} and cameras.pkl turn differently at {len(off)} frames (first "
            f"{images[off[0]].name}): rows of poses_bounds.npy must follow the sorted image names"
        )
    return rows[:, 15:]


def _body(folder: Path, images: Sequence[Path], rig: _Rig, smpl: Path) -> BodyTrack:
    """SMPL poses in the metric world: x = A (R(Rh) v + Th) / scale, v posed about tpose_joints."""
    table = _by_name(folder / "mesh_infos.pkl", images)
    keys = {"poses": 72, "tpose_joints": 72, "Rh": 3, "Th": 3}
    columns = {}
    for key, width in keys.items():
        rows = []
        for name, row in table.items():
            where = f"{folder / 'mesh_infos.pkl'}: {name}"
            rows.append(numbers(entry(row, key, where), f"{where}: {key}", width, flat=True))
        columns[key] = torch.from_numpy(np.stack(rows))
    rest = columns["tpose_joints"].unflatten(-1, (24, 3))
    shapes = rest - rest[:, :1]
    # HumanNeRF's preparation has a shape for each frame; joints are linear in it, so their
    # mean is that of the mean shape
    shape = shapes.mean(0)
    spread = float((shapes - shape).norm(dim=-1).max())
    if spread > ANOTHER_PERSON:
        raise ClipError(
            f"{folder}/mesh_infos.pkl: tpose_joints of some frame are {100 * spread:.0f} cm off "
            "their mean: they are not of one person"
        )
    body = body_model("body:smpl", smpl)
    betas = betas_of_joints(body, shape[:22])
    pelvis = body.shaped(betas)[1][0].double()
    similar = torch.from_numpy(rig.smpl_to_world)
    turn = axis_angle_to_matrices(columns["Rh"])
    place = (turn @ rest[:, 0, :, None])[..., 0] + columns["Th"]
    place = (similar[:, :3, :3] @ place[..., None])[..., 0] + similar[:, :3, 3]
    rotation = similar[:, :3, :3] / torch.linalg.det(similar[:, :3, :3]).pow(1 / 3)[:, None, None]
    orient = rotation @ turn @ axis_angle_to_matrices(columns["poses"][:, :3])
    angles = torch.cat((matrices_to_axis_angle(orient), columns["poses"][:, 3:]), -1)
    pose = pose_from_smpl(angles, place / rig.scale - pelvis, betas.double()).to(torch.float32)
    return BodyTrack(
        "body:smpl",
        pose,
        f"mesh_infos.pkl; betas from its zero-pose joints, which vary by {1000 * spread:.1f} mm",
    )


class _ObjectRemoved(OverStore):
    """Frames whose mask of the person has the pixels of the object removed."""

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        mask = self.base.mask(entity, position)
        return mask & ~self.base.mask("object", position) if entity == "human" else mask


def _any(image: Image.Image) -> Array:
    return np.asarray(image.convert("L")) > 0


def _matrix(row: Any, key: str, where: str) -> Float[Array, "4 4"]:
    return numbers(entry(row, key, where), f"{where}: {key}", 16, flat=True).reshape(4, 4)
