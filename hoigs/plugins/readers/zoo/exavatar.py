"""reader:exavatar: a video of one person, as ExAvatar's preparation and fitting leave it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.model.smpl_params import moved_pose, pose_from_smplx
from hoigs.core.system.files import short
from hoigs.core.values.clip import BodyTrack, Clip
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.checked_files import (
    Need,
    VideoReaderConfig,
    load_json,
    numbers,
    parse_json,
    read_lines,
    require_files,
)
from hoigs.plugins.readers.colmap import View, model_folder, read_sparse, sparse_needs
from hoigs.plugins.readers.lazy_frames import (
    IMAGE_SUFFIXES,
    LazyFrames,
    MaskFiles,
    PixelFiles,
    image_size,
    lens_for,
    video_moments,
)
from hoigs.plugins.readers.points import Points, body_model, checked_rotation, rigid

# The files of an ExAvatar folder: frames by number, lists, cameras and background points.

FITTING = "ExAvatar's fitting makes it (fitting/tools/run.py; github.com/mks0601/ExAvatar_RELEASE)"
LISTS = "you write it: one frame number on each line (ExAvatar's fitting/README.md)"
BACKGROUND = "COLMAP makes it; ExAvatar's bkg_point_cloud.txt serves a fixed camera"
CAMERAS = "COLMAP makes it; ExAvatar's make_virtual_cam_params.py for a camera that stands still"
FRAMES = "the video's frames, I.png"
OPTIMIZED, POINTS = "smplx_optimized", "bkg_point_cloud.txt"
LONGEST = 9  # digits of a frame's number
USES = ("train", "test")
POSE_FOLDERS = ("smplx_params_smoothed", "smplx_params")
Array = np.ndarray


class CameraJson(BaseModel):
    """cam_params/I.json: world-to-camera, pixels."""

    R: list[list[float]]
    t: list[float] = Field(min_length=3, max_length=3)
    focal: tuple[float, float]
    princpt: tuple[float, float]


@dataclass(frozen=True)
class FrameFiles:
    """Files by frame number."""

    images: Mapping[int, Path]
    masks: Mapping[int, Path]
    poses: Mapping[int, Path]

    @staticmethod
    def of(folder: Path) -> FrameFiles:
        return FrameFiles(
            _numbered(folder / _image_folder(folder), IMAGE_SUFFIXES),
            _numbered(folder / "masks", IMAGE_SUFFIXES),
            _numbered(folder / OPTIMIZED / _pose_folder(folder), (".json",)),
        )


def _numbered(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    found = sorted(folder.glob("*"))
    return {int(p.stem): p for p in found if p.suffix.lower() in suffixes and p.stem.isdecimal()}


def _image_folder(folder: Path) -> str:
    return "images" if not (folder / "frames").is_dir() and _is_neuman(folder) else "frames"


def _is_neuman(folder: Path) -> bool:
    """ExAvatar's NeuMan variant lists images by name."""
    return (folder / "train_split.txt").is_file()


def _pose_folder(folder: Path) -> str:
    there = [name for name in POSE_FOLDERS if (folder / OPTIMIZED / name).is_dir()]
    return there[0] if there else POSE_FOLDERS[0]


def _has_model(folder: Path) -> bool:
    return model_folder(folder, "sparse") is not None


def _lists(folder: Path) -> dict[str, str]:
    """Names of the split's files by use."""
    if _is_neuman(folder):
        uses = ("train", "val", "test") if (folder / "val_split.txt").is_file() else USES
        return {use: f"{use}_split.txt" for use in uses}
    there = (folder / "frame_list_all.txt").is_file()
    return {use: f"frame_list_{use}.txt" for use in (*USES, *(["all"] if there else []))}


def folder_needs(folder: Path) -> list[Need]:
    needs = [Need.of(f"{_image_folder(folder)}/", maker=FRAMES)]
    needs += [Need.of(name, maker=LISTS) for name in _lists(folder).values()]
    needs.append(Need.of("masks/", maker=FITTING))
    needs.append(Need.of(f"{OPTIMIZED}/{_pose_folder(folder)}/", maker=FITTING))
    needs.append(Need.of(f"{OPTIMIZED}/shape_param.json", maker=FITTING))
    if _has_model(folder):
        needs += sparse_needs(folder, "sparse", points=False)
    else:
        needs.append(Need.of("sparse/cameras.txt", "cam_params/", maker=CAMERAS))
    return [*needs, Need.of("sparse/points3D.txt", "sparse/points3D.bin", POINTS, maker=BACKGROUND)]


def read_split(folder: Path) -> dict[str, list[int]]:
    """Frame numbers by use.

    Raises:
        ClipError: a line that is neither a number nor an image's name.
    """
    split = {}
    for use, name in _lists(folder).items():
        lines = read_lines(folder / name)
        stems = [Path(line).stem for line in lines]
        wrong = [x for x, stem in zip(lines, stems) if not stem.isdecimal() or len(stem) > LONGEST]
        if wrong or not lines:
            what = f"has the line {short(wrong[0])}" if wrong else "is empty"
            raise ClipError(f"{folder / name} {what}; expected one frame number on each line")
        split[use] = sorted({int(stem) for stem in stems})
    return split


def colmap_views(folder: Path) -> dict[int, View] | None:
    """COLMAP's images by the number in their names; None without a model."""
    if not _has_model(folder):
        return None
    found = {}
    for view in read_sparse(folder / "sparse").views:
        digits = re.findall(r"[0-9]+", Path(view.name).stem)
        if not digits:
            raise ClipError(f'{folder / "sparse"}: image "{view.name}" has no number in its name')
        found[int(digits[-1])] = view
    return found


def virtual_view(folder: Path, number: int, image: Path) -> View:
    path = folder / "cam_params" / f"{number}.json"
    camera = parse_json(path, CameraJson)
    rotation = checked_rotation(numbers(camera.R, f"{path}: R", 3, 3), str(path))
    lens = Lens("PINHOLE", (*camera.focal, *camera.princpt), *image_size(image))
    return View(image.name, lens, rigid(rotation, np.array(camera.t, np.float64)))


def frame_needs(
    folder: Path,
    files: FrameFiles,
    views: Mapping[int, View] | None,
    split: Mapping[str, Sequence[int]],
    numbers: Sequence[int],
) -> tuple[list[Need], list[str]]:
    """Files that the listed frames need, and problems of the lists."""
    images, poses, needs = _image_folder(folder), _pose_folder(folder), []
    for n in numbers:
        if n not in files.images:
            needs.append(Need.of(f"{images}/{n}.png", maker=FRAMES))
        stem = files.images[n].stem if n in files.images else str(n)
        if n not in files.masks:
            needs.append(Need.of(f"masks/{stem}.png", maker=FITTING))
        if n not in files.poses:
            needs.append(Need.of(f"{OPTIMIZED}/{poses}/{n}.json", maker=FITTING))
        if views is None:
            needs.append(Need.of(f"cam_params/{n}.json", maker=CAMERAS))
    problems = []
    unregistered = [n for n in numbers if views is not None and n not in views]
    if unregistered:
        shown = ", ".join(map(str, unregistered[:8])) + (", …" if len(unregistered) > 8 else "")
        problems.append(
            f"sparse/ has no camera for {len(unregistered)} of {len(numbers)} listed frames "
            f"({shown}): COLMAP did not register them; remove them from the lists"
        )
    both = sorted(set(split["train"]) & set(split["test"]))
    if both:
        problems.append(f"{len(both)} frames are in both train and test lists (first {both[0]})")
    return needs, problems


def background_points(folder: Path) -> tuple[*Points, str]:
    if model_folder(folder, "sparse") is not None:
        model = read_sparse(folder / "sparse")
        if len(model.points):
            return model.points, model.colors, model.summary
    path = folder / POINTS
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        why = f"{path} cannot be read ({error}); expected lines of x y z r g b"
        raise ClipError(why) from error
    if rows.shape[1] != 6 or not len(rows):
        raise ClipError(f"{path} has shape {list(rows.shape)}, expected lines of x y z r g b")
    values = torch.from_numpy(rows).float()
    return values[:, :3], values[:, 3:] / 255, POINTS


LAYOUT = "an ExAvatar folder"
NO_POSES = (
    "no poses without an SMPL-X model, whose pelvis is needed to transform them to the world: "
    "--reader exavatar --reader-set smplx=SMPLX_NEUTRAL.npz"
)


class SmplxJson(BaseModel):
    """A frame's SMPL-X parameters, in that frame's camera."""

    root_pose: list[float] = Field(min_length=3, max_length=3)
    body_pose: list[list[float]]
    lhand_pose: list[list[float]]
    rhand_pose: list[list[float]]
    trans: list[float] = Field(min_length=3, max_length=3)


class ExavatarConfig(VideoReaderConfig):
    """Settings of reader:exavatar."""

    smplx: Path | None = Field(
        default=None, description="your SMPLX_*.npz; without it, no poses if the camera moves"
    )
    num_betas: int = Field(
        default=100,
        ge=1,
        le=300,
        description="shape coefficients kept; the spec's body has as many",
    )


class ExavatarReader(ClipReader):
    """Cameras of COLMAP or a virtual fixed one, person masks, points, SMPL-X in the world.

    Read as ExAvatar's own Custom.py, or NeuMan.py (images/, *_split.txt), does. Poses have flat
    hands and stand in each frame's camera; the world's unit is the metre, as the fit has it.
    ExAvatar's joint, face and locator offsets, jaw, eyes and expression have no place in a
    BodyPose; its depth maps have no common scale and are not read.
    """

    Config: ClassVar = ExavatarConfig
    config: ExavatarConfig

    def matches(self, folder: Path) -> bool:
        folder = Path(folder)
        return (folder / OPTIMIZED).is_dir() or (folder / "frame_list_train.txt").is_file()

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        require_files(folder, LAYOUT, folder_needs(folder))
        split = read_split(folder)
        numbers = sorted({n for used in split.values() for n in used})
        files = FrameFiles.of(folder)
        views = colmap_views(folder)
        require_files(folder, LAYOUT, *frame_needs(folder, files, views, split, numbers))
        images = [files.images[n] for n in numbers]
        lenses, matrices = [], []
        for number, image in zip(numbers, images):
            view = views[number] if views is not None else virtual_view(folder, number, image)
            lenses.append(lens_for(view.lens, image))
            matrices.append(view.world_to_camera)
        cameras = [lens.camera(matrix) for lens, matrix in zip(lenses, matrices)]
        bodies = self._bodies(folder, [files.poses[n] for n in numbers], np.stack(matrices))
        points, colors, origin = background_points(folder)
        step = max(math.gcd(*(n - numbers[0] for n in numbers)), 1)
        indices = [(n - numbers[0]) // step for n in numbers]
        provenance: dict[str, Any] = {
            "reader": "reader:exavatar",
            "cameras": "cam_params/, a virtual camera" if views is None else "sparse/, by COLMAP",
            "points": origin,
        }
        if not bodies:
            provenance["poses of human"] = NO_POSES
        masks = MaskFiles([files.masks[n] for n in numbers])
        pixels = PixelFiles(images, masks={"human": masks})
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb),
            cameras=cameras,
            moments=video_moments(indices, indices[-1] + 1, bodies),
            kinds={"human": "human"},
            bodies=bodies,
            points=points,
            point_colors=colors,
            split={
                use: [numbers.index(n) for n in used] for use, used in split.items() if use != "all"
            },
            fps=self.config.fps,
            provenance=provenance,
        )

    def _bodies(
        self, folder: Path, paths: Sequence[Path], world_to_camera: Float[Array, "F 4 4"]
    ) -> dict[str, BodyTrack]:
        """SMPL-X taken from the cameras into the world; no track where that cannot be done."""
        still = bool(np.abs(world_to_camera - np.eye(4)).max() == 0)
        if self.config.smplx is None and not still:
            return {}
        path = folder / OPTIMIZED / "shape_param.json"
        shape = numbers(load_json(path), str(path), flat=True)
        betas = torch.from_numpy(shape[: self.config.num_betas])
        pelvis = torch.zeros(3, dtype=torch.float64)
        if self.config.smplx is not None:
            body = body_model("body:smplx", self.config.smplx, num_betas=len(betas))
            pelvis = body.shaped(betas.float())[1][0].double()
        frames = [parse_json(path, SmplxJson) for path in paths]
        columns = {"global_orient": "root_pose", "body_pose": "body_pose", "transl": "trans",
                   "left_hand_pose": "lhand_pose", "right_hand_pose": "rhand_pose"}  # fmt: skip
        parameters = {
            ours: _stacked(paths, [getattr(frame, theirs) for frame in frames], theirs)
            for ours, theirs in columns.items()
        }
        pose = pose_from_smplx({**parameters, "betas": betas}, hands="flat")
        back = torch.from_numpy(world_to_camera[:, :3, :3]).mT
        shift = -(back @ torch.from_numpy(world_to_camera[:, :3, 3:]))[..., 0]
        world = moved_pose(pose, pelvis, back, shift).to(torch.float32)
        origin = f"{paths[0].parent.name}, without ExAvatar's joint and face offsets"
        return {"human": BodyTrack("body:smplx", world, origin)}


def _stacked(paths: Sequence[Path], rows: Sequence[Any], key: str) -> torch.Tensor:
    """[F, N] float64 of one key of all files."""
    flat = [
        numbers([x for part in row for x in np.ravel(part)], f"{path}: {key}")
        for path, row in zip(paths, rows)
    ]
    for path, row in zip(paths, flat):
        if len(row) != len(flat[0]):
            raise ClipError(f"{path}: {key} has {len(row)} numbers, others have {len(flat[0])}")
    return torch.from_numpy(np.stack(flat).astype(np.float64))
