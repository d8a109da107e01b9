"""reader:exavatar: a video of one person, as ExAvatar's preparation and fitting leave it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, Field

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.model.smpl_params import moved_pose, pose_from_smplx
from hoigs.core.values.clip import BodyTrack, Clip
from hoigs.plugins.readers.common.config import VideoReaderConfig
from hoigs.plugins.readers.common.frame_order import video_moments
from hoigs.plugins.readers.common.json_file import load_json, parse_json
from hoigs.plugins.readers.common.lazy_frames import LazyFrames, MaskFiles, lens_for
from hoigs.plugins.readers.common.listing import require_files
from hoigs.plugins.readers.common.numbers import numbers
from hoigs.plugins.readers.common.poses import body_model
from hoigs.plugins.readers.exavatar.files import (
    OPTIMIZED,
    FrameFiles,
    background_points,
    colmap_views,
    folder_needs,
    frame_needs,
    read_split,
    virtual_view,
)

LAYOUT = "an ExAvatar folder"
NO_POSES = (
    "no poses without an SMPL-X model, whose pelvis is needed to transform them to the world: "
    "--reader exavatar --reader-set smplx=SMPLX_NEUTRAL.npz"
)
Array = np.ndarray


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
        return Clip(
            name=folder.resolve().name,
            store=LazyFrames(
                folder,
                images,
                cameras,
                masks={"human": MaskFiles([files.masks[n] for n in numbers])},
                lenses=lenses,
                cache_mb=self.config.cache_mb,
            ),
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
        betas = torch.from_numpy(
            numbers(load_json(path), str(path), flat=True)[: self.config.num_betas]
        )
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
