"""A COLMAP model folder: lenses, poses and points, with names as its images have them."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.files.colmap_files import PARTS, holds_model, models_in
from hoigs.core.values.lens import Lens
from hoigs.plugins.readers.common.frame_order import natural
from hoigs.plugins.readers.common.listing import Need
from hoigs.plugins.readers.common.poses import rigid

MAKER = "COLMAP makes the sparse model (`colmap mapper`; mask out what moves)"
# of an entry in a binary file: bytes before its own count, of that count, of each that it counts
ENTRY_BYTES = {
    "cameras": (24, 0, 0), "images": (64, 8, 24), "points3D": (43, 8, 8),
    "rigs": (8, 0, 0), "frames": (64, 4, 16),
}  # fmt: skip


@dataclass(frozen=True)
class View:
    """One registered image.

    Attributes:
        name: as in the COLMAP model. world_to_camera: OpenCV axes, COLMAP's own unit.
    """

    name: str
    lens: Lens
    world_to_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class SparseModel:
    """Views in natural order of their names; points and RGB in [0, 1]."""

    views: list[View]
    points: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    summary: str


def model_folder(folder: Path, place: str | None = None) -> str | None:
    """The model under `folder`, complete or not: the largest in sparse/, the first of equal ones,
    or the one in `place`; None: there is none."""
    if place is not None:
        return place if holds_model(folder / place) else None
    found = models_in(folder / "sparse")
    return f"sparse/{max(found, key=lambda n: found[n])}".rstrip("/") if found else None


def sparse_needs(
    folder: Path, place: str | None = None, points: bool = True, maker: str = MAKER
) -> list[Need]:
    """The files of a sparse model, in the form (binary or text) that is there already."""
    whole = model_folder(folder, place) is None
    place = model_folder(folder, place) or place or "sparse/0"
    parts = PARTS if points else PARTS[:2]
    form = "txt" if any((folder / place / f"{p}.txt").is_file() for p in PARTS) else "bin"
    if all((folder / place / f"{p}.bin").is_file() for p in parts):
        form = "bin"
    other = "bin" if form == "txt" else "txt"
    return [
        Need((f"{place}/{p}.{form}", f"{place}/{p}.{other}") if whole else (f"{place}/{p}.{form}",),
             maker)
        for p in parts
    ]  # fmt: skip


def read_sparse(folder: Path) -> SparseModel:
    """The model in `folder`; one without points3D has no points.

    Raises:
        ClipError: it is damaged, or registers no image.
    """
    from hoigs.core.machine.colmap import read_model

    _require_counts_fit(folder)
    try:
        if any((folder / f"points3D.{s}").is_file() for s in ("bin", "txt")):
            model: Any = read_model(folder)
        else:
            model = _without_points(folder)
        registered = sorted(model.images.values(), key=lambda i: natural(i.name))
    except (RuntimeError, ValueError, IndexError) as error:
        raise ClipError(f"{folder} is not a readable COLMAP model: {error}") from error
    for number, camera in model.cameras.items():
        if not np.isfinite(camera.params).all() or min(camera.width, camera.height) < 1:
            raise ClipError(f"{folder}: camera {number} is {camera.todict()}; run COLMAP again")
    lenses = {}
    for number, c in model.cameras.items():
        params = tuple(float(p) for p in c.params)
        try:
            lenses[number] = Lens(c.model_name, params, c.width, c.height)
        except ClipError as error:
            raise ClipError(f"{folder}: camera {number}: {error}") from error
    views = []
    for image in registered:
        if image.has_pose:
            pose = np.asarray(image.cam_from_world().matrix(), np.float64)
            name = image.name.replace("\\", "/")  # of a COLMAP on Windows
            views.append(View(name, lenses[image.camera_id], rigid(pose[:, :3], pose[:, 3])))
    if not views:
        raise ClipError(
            f"{folder} registers no image; run COLMAP again, with moving objects masked"
        )
    points = list(model.points3D.values())
    places = torch.tensor(np.array([p.xyz for p in points]).reshape(-1, 3)).float()
    if not places.isfinite().all():
        raise ClipError(f"{folder}: points are not finite; run COLMAP again")
    models = ", ".join(sorted({lens.model for lens in lenses.values()}))
    return SparseModel(
        views,
        places,
        torch.tensor(np.array([p.color for p in points]).reshape(-1, 3)).float() / 255,
        f"COLMAP {models}, {len(views)} images, {len(points)} points",
    )


def _require_counts_fit(folder: Path) -> None:
    """Counts in binary files fit the files: pycolmap believes them, and reads for minutes.

    Raises:
        ClipError: a file says that it has more than it holds.
    """
    for part, (head, width, each) in ENTRY_BYTES.items():
        path = folder / f"{part}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        count, place = int.from_bytes(data[:8], "little"), 8
        whole = len(data) >= 8 + count * (head + width)
        for _ in range(count if whole and width else 0):
            place += head
            if part == "images":
                place = data.find(b"\0", place) + 1 or len(data)  # the name
            place += width + each * int.from_bytes(data[place : place + width], "little")
            if place > len(data):
                whole = False
                break
        if not whole:
            raise ClipError(
                f"{path} is not a readable COLMAP file: it says {count:,} entries, which do not "
                f"fit its {len(data):,} bytes; copy it again, or run COLMAP again"
            )


def _without_points(folder: Path) -> Any:
    """cameras.txt and images.txt alone: pycolmap needs all three files, and tracks that exist."""
    from hoigs.core.machine.colmap import read_model

    lines = (folder / "images.txt").read_text(encoding="utf-8").split("\n")
    rows = [line for line in lines if not line.startswith("#")]
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        shutil.copy(folder / "cameras.txt", place)
        # each image has two lines; the second has its observations and may be empty
        (place / "images.txt").write_text("".join(f"{row}\n\n" for row in rows[::2] if row.strip()))
        (place / "points3D.txt").write_text("")
        return read_model(place)
