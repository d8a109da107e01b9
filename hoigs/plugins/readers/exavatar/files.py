"""The files of an ExAvatar folder: frames by number, lists, cameras and background points."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from pydantic import BaseModel, Field

from hoigs.core.errors import ClipError
from hoigs.core.files.json_file import short
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.common.colmap_model import View, model_folder, read_sparse, sparse_needs
from hoigs.plugins.readers.common.frame_order import IMAGE_SUFFIXES
from hoigs.plugins.readers.common.json_file import parse_json
from hoigs.plugins.readers.common.lazy_frames import image_size
from hoigs.plugins.readers.common.listing import Need
from hoigs.plugins.readers.common.numbers import numbers, read_lines
from hoigs.plugins.readers.common.point_file import Points
from hoigs.plugins.readers.common.poses import checked_rotation, rigid

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
        raise ClipError(
            f"{path} cannot be read ({error}); expected lines of x y z r g b"
        ) from error
    if rows.shape[1] != 6 or not len(rows):
        raise ClipError(f"{path} has shape {list(rows.shape)}, expected lines of x y z r g b")
    values = torch.from_numpy(rows).float()
    return values[:, :3], values[:, 3:] / 255, POINTS
