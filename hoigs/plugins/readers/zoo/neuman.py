"""reader:neuman: videos of a walking person, as NeuMan published them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.maths.rotations import axis_angle_to_matrices, matrices_to_axis_angle
from hoigs.core.model.smpl_params import pose_from_smpl
from hoigs.core.system.files import regular_file, short
from hoigs.core.system.joblib_file import load_joblib
from hoigs.core.system.unpickling import load_pickled_npy
from hoigs.core.values.clip import BodyTrack, Clip
from hoigs.plugins.readers.checked_files import (
    Need,
    VideoReaderConfig,
    entry,
    numbers,
    read_lines,
    require_files,
)
from hoigs.plugins.readers.colmap import SparseModel, View, read_sparse, sparse_needs
from hoigs.plugins.readers.lazy_frames import (
    DepthFiles,
    LazyFrames,
    MaskFiles,
    PixelFiles,
    dark,
    image_files,
    lens_for,
    video_moments,
)
from hoigs.plugins.readers.points import body_model

LAYOUT = "a NeuMan scene"
AUTHORS = "it is in the authors' download (github.com/apple/ml-neuman)"
MAKERS = {
    "sparse": f"{AUTHORS}; COLMAP makes it",
    "masks": f"{AUTHORS}; Detectron2 makes it, with a white background",
    "smpl": f"{AUTHORS}; ROMP and preprocess/optimize_smpl.py make it",
    "alignments": f"{AUTHORS}; preprocess/export_alignment.py makes it",
    "split": f"{AUTHORS}; create_split_files of data_io/neuman_helper.py makes it",
}
SMPL_FILES = ("smpl_output_optimized.pkl", "smpl_output_romp.pkl")
SPLITS = ("train", "val", "test")
NO_POSES = (
    "no poses without an SMPL model, whose pelvis places them: "
    "--reader neuman --reader-set smpl=SMPL_NEUTRAL.npz"
)
Array = np.ndarray


class NeumanConfig(VideoReaderConfig):
    """Settings of reader:neuman."""

    smpl: Path | None = Field(
        default=None, description="your neutral SMPL model as .npz; without it, no body poses"
    )


class NeumanReader(ClipReader):
    """Cameras, points, MVS depth, person masks and SMPL poses, in metres.

    alignments.npy puts each frame's body into COLMAP's world by its own similarity. The median
    of their scales turns COLMAP's unit into metres. Where a frame's scale differs, its body
    keeps its size and moves along the line from the camera, so that it looks as it did. Shape is
    the median of the frames' betas.
    """

    Config: ClassVar = NeumanConfig
    config: NeumanConfig

    def matches(self, folder: Path) -> bool:
        folder = Path(folder)
        own = ("alignments.npy", *SMPL_FILES)
        return (folder / "images").is_dir() and any((folder / name).is_file() for name in own)

    def read(self, folder: Path) -> Clip:
        folder = Path(folder)
        files = {path.name: path for path in image_files(folder / "images")}
        require_files(folder, LAYOUT, _needs(folder, list(files)))
        model = read_sparse(folder / "sparse")
        names = [Path(view.name).name for view in model.views]
        absent = [Need.of(f"images/{n}", maker=AUTHORS) for n in names if n not in files]
        require_files(folder, LAYOUT, absent)
        alignments = _alignments(folder / "alignments.npy", names)
        unit = float(np.median(alignments.scales))
        views = [_metric(view, unit) for view in model.views]
        lenses = [lens_for(view.lens, files[name]) for view, name in zip(views, names)]
        cameras = [lens.camera(view.world_to_camera) for lens, view in zip(lenses, views)]
        depths = [folder / "depth_maps" / f"{name}.geometric.bin" for name in names]
        depth = [path if path.is_file() else None for path in depths]
        masks = [folder / "segmentations" / name for name in names]
        bodies = {}
        if self.config.smpl is not None:
            bodies["human"] = _body(folder, names, model, alignments, unit, self.config.smpl)
        order = {name: i for i, name in enumerate(files)}
        spread = np.ptp(alignments.scales) / unit
        provenance: dict[str, Any] = {
            "reader": "reader:neuman",
            "cameras": f"{model.summary}, divided by {unit:.6g} (median of alignments.npy): metres",
            "body scale": f"alignments' scales spread over {100 * spread:.1f} % of their median",
        }
        if not bodies:
            provenance["poses of human"] = NO_POSES
        pixels = PixelFiles(
            [files[name] for name in names],
            masks={"human": MaskFiles(masks, dark)},
            depth=DepthFiles(depth, 1 / unit, read_mvs_depth) if any(depth) else None,
        )
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(folder, pixels, cameras, lenses=lenses, cache_mb=self.config.cache_mb),
            cameras=cameras,
            moments=video_moments([order[name] for name in names], len(files), bodies),
            kinds={"human": "human"},
            bodies=bodies,
            points=model.points / unit,
            point_colors=model.colors,
            split={use: _listed(folder, use, names) for use in SPLITS},
            fps=self.config.fps,
            depth_kind="metric" if any(depth) else "none",
            provenance=provenance,
        )


def _needs(folder: Path, images: Sequence[str]) -> list[Need]:
    needs = [] if images else [Need.of("images/00000.png", maker=AUTHORS)]
    needs += sparse_needs(folder, "sparse", maker=MAKERS["sparse"])
    needs += [Need.of(f"segmentations/{name}", maker=MAKERS["masks"]) for name in images]
    needs.append(Need.of(*SMPL_FILES, maker=MAKERS["smpl"]))
    needs.append(Need.of("alignments.npy", maker=MAKERS["alignments"]))
    return needs + [Need.of(f"{use}_split.txt", maker=MAKERS["split"]) for use in SPLITS]


@dataclass(frozen=True)
class _Alignments:
    """x_world = scale R x_smpl + t, one row for each frame, in COLMAP's unit."""

    scales: Float[Array, " F"]
    rotations: Float[Array, "F 3 3"]
    shifts: Float[Array, "F 3"]


def _alignments(path: Path, names: Sequence[str]) -> _Alignments:
    table = load_pickled_npy(path)
    if not isinstance(table, dict):
        raise ClipError(f"{path} holds {type(table).__name__}, expected a dict by image name")
    absent = [name for name in names if name not in table]
    if absent:
        raise ClipError(
            f"{path} has no entry for {len(absent)} of {len(names)} images "
            f"({', '.join(absent[:4])}); {MAKERS['alignments']}"
        )
    rows = np.stack([numbers(table[name], f"{path}: {name}", 4, 3) for name in names])
    matrices = rows[:, :3].transpose(0, 2, 1)  # written for row vectors
    determinants = np.linalg.det(matrices)
    if (determinants <= 0).any():
        first = names[int(np.argmax(determinants <= 0))]
        raise ClipError(f"{path}: {first} is mirrored or flat, not a similarity")
    scales = np.cbrt(determinants)
    return _Alignments(scales, matrices / scales[:, None, None], rows[:, 3])


def _metric(view: View, unit: float) -> View:
    w2c = view.world_to_camera.copy()
    w2c[:3, 3] /= unit
    return View(view.name, view.lens, w2c)


def _body(
    folder: Path,
    names: Sequence[str],
    model: SparseModel,
    alignments: _Alignments,
    unit: float,
    smpl: Path,
) -> BodyTrack:
    """SMPL poses in the world; NeumanReader describes how they are placed."""
    path = next(folder / name for name in SMPL_FILES if (folder / name).is_file())
    poses, betas = _smpl_rows(path, names)
    shape = betas.median(0).values
    body = body_model("body:smpl", smpl)
    pelvis = body.shaped(betas.float())[1][:, 0].double()
    middle = body.shaped(shape.float())[1][0].double()
    turn = torch.from_numpy(alignments.rotations)
    scale = torch.from_numpy(alignments.scales)[:, None]
    place = scale * (turn @ pelvis[..., None])[..., 0] + torch.from_numpy(alignments.shifts)
    w2c = torch.from_numpy(np.stack([view.world_to_camera for view in model.views]))
    eye = -(w2c[:, :3, :3].mT @ w2c[:, :3, 3:])[..., 0]
    place = eye / unit + (place - eye) / scale  # to one size, along the line of sight
    orient = matrices_to_axis_angle(turn @ axis_angle_to_matrices(poses[:, :3]))
    angles = torch.cat((orient, poses[:, 3:]), -1)
    track = pose_from_smpl(angles, place - middle, shape).to(torch.float32)
    off = float((betas - shape).abs().max())
    origin = f"{path.name}, alignments.npy; betas are the median, frames differ by {off:.2f}"
    return BodyTrack("body:smpl", track, origin, gender="neutral")


def _smpl_rows(path: Path, names: Sequence[str]) -> tuple[torch.Tensor, torch.Tensor]:
    """pose [F, 72] and betas [F, 10]; rows are numbered as the images are named."""
    content = load_joblib(path)
    people = list(content.values()) if isinstance(content, dict) else []
    if len(people) != 1:
        raise ClipError(f"{path}: expected one person with pose and betas")
    columns = []
    for key, width in (("pose", 72), ("betas", 10)):
        rows = numbers(entry(people[0], key, str(path)), f"{path}: {key}")
        rows = rows.reshape(len(rows), -1)[:, :width] if rows.size else rows.reshape(0, width)
        frames = [int(Path(name).stem) for name in names]
        if rows.shape[1] != width or max(frames) >= len(rows):
            raise ClipError(
                f"{path}: {key} has shape {list(rows.shape)}; expected rows up to "
                f"{max(frames)}, the last image's number, of {width}"
            )
        columns.append(torch.from_numpy(rows[frames]))
    return columns[0], columns[1]


def _listed(folder: Path, use: str, names: Sequence[str]) -> list[int]:
    path = folder / f"{use}_split.txt"
    wanted = read_lines(path)
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise ClipError(
            f"{path} names {', '.join(map(short, unknown[:4]))}: not among the images that sparse/ "
            "registers"
        )
    return sorted(names.index(name) for name in wanted)


def read_mvs_depth(path: Path) -> Float[Array, "H W"]:
    """A depth map of COLMAP's patch_match_stereo: "W&H&1&" and float32, row by row.

    Raises:
        ClipError: it cannot be read.
    """
    content = regular_file(path).read_bytes()
    header = content[:64].split(b"&", 3)
    try:
        width, height, channels = (int(part) for part in header[:3])
        start = sum(len(part) + 1 for part in header[:3])
        values = np.frombuffer(content[start:], "<f4").reshape(channels, height, width)
    except ValueError as error:
        raise ClipError(f"{path} is not a depth map of COLMAP ({error}); write it again") from error
    return values[0]
