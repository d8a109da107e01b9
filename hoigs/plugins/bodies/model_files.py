"""The user's own model files of the SMPL family: reading and checking them."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.files.npz import plain_reason
from hoigs.core.values.clip import BodyTrack

Layout = Mapping[str, tuple[int | str, ...]]
HANDS = ("hands_meanl", "hands_meanr")  # where a file has them
GENDERS = ("female", "male", "neutral")


def read_model(key: str, path: Path, layout: Layout, where: str) -> dict[str, np.ndarray]:
    """The arrays of a model file, with their shapes checked; nothing is unpickled.

    Args:
        key: of the component, for messages. where: a sentence on where such files come from.
        layout: shape of each array by its key; a letter has one value within a file.

    Raises:
        HoigsError: the file is absent, not an .npz file, or has another layout.
    """
    if not path.is_file():
        raise HoigsError(f"{key}: there is no file {path}; {where}")
    name = where.partition(" model files")[0]
    try:
        opened = np.load(path, allow_pickle=False)
        if not isinstance(opened, np.lib.npyio.NpzFile):
            raise ValueError("it holds a single array")
        with opened as file:
            missing = [k for k in layout if k not in file.files]
            if missing:
                raise HoigsError(
                    f"{path} is not a complete {name} model: it lacks {', '.join(missing)} (found "
                    f"{', '.join(sorted(file.files)) or 'nothing'}); {where}"
                )
            hands = [k for k in HANDS if k in file.files]
            arrays = {k: file[k] for k in (*layout, *hands)}
    except (ValueError, EOFError, OSError, OverflowError, zipfile.BadZipFile) as error:
        # pickles are refused with a ValueError
        reason = plain_reason(error)
        raise HoigsError(f"{path} is not an {name} .npz file ({reason}); {where}") from error
    own = {**layout, **dict.fromkeys(HANDS, (45,))} if hands else layout
    _check_shapes(path, arrays, own, name, where)
    return arrays


def _check_shapes(
    path: Path, arrays: Mapping[str, np.ndarray], layout: Layout, name: str, where: str
) -> None:
    sizes: dict[str, int] = {}
    for key, form in layout.items():
        if key not in arrays:
            raise HoigsError(f"{path}: it has one mean hand, but no {key}; {where}")
        if arrays[key].dtype.kind not in "biuf":
            raise HoigsError(f"{path}: {key} holds {arrays[key].dtype}, expected numbers; {where}")
        shape = arrays[key].shape
        expected = [sizes.get(n, n) if isinstance(n, str) else n for n in form]
        fits = len(shape) == len(form) and all(
            isinstance(size, str) or size == found
            for size, found in zip(expected, shape, strict=True)
        )
        if not fits:
            family = any(isinstance(n, int) and n > 3 for n in form)
            raise HoigsError(
                f"{path}: {key} has shape {list(shape)}, {name} has {expected} there"
                + ("; files of SMPL, SMPL+H and SMPL-X do not fit each other" if family else "")
                + f"; {where}"
            )
        sizes.update({n: s for n, s in zip(form, shape, strict=True) if isinstance(n, str)})
        if not np.isfinite(arrays[key]).all():
            raise HoigsError(f"{path}: {key} holds NaN or infinity; download the file again")


def read_template(path: Path) -> Float[Tensor, "V 3"]:
    """A person's zero-pose vertices from a mesh file, in the model's order, metres.

    Raises:
        HoigsError: the file is absent or not a mesh.
    """
    import trimesh

    if not path.is_file():
        raise HoigsError(f"{path}: no such file; `template` is a mesh of the model's vertices")
    try:
        mesh: Any = trimesh.load(path, process=False, maintain_order=True, allow_remote=False)
        points = np.asarray(mesh.vertices, dtype=np.float64)
    except Exception as error:  # trimesh raises errors of any kind on a damaged file
        raise HoigsError(f"{path} is not a mesh ({type(error).__name__}: {error})") from error
    return torch.from_numpy(points)


def file_gender(path: Path) -> str | None:
    """The gender in a model file's name or its folder's (SMPLX_MALE.npz, smplh/male/model.npz)."""
    for part in (path.stem, path.parent.name):
        words = re.split(r"[^a-z]+", part.lower())
        found = [g for g in GENDERS if g in words]
        if len(found) == 1:
            return found[0]
    return None


def require_gender(key: str, path: Path, track: BodyTrack | None) -> None:
    """Refuse a model file of another gender than that of the model the track was fitted with.

    A neutral body in place of a male or female one gives overlays that are visibly shifted
    (zc-alexfan/arctic#52). A file whose name has no gender is accepted.

    Raises:
        HoigsError: the file's name has another gender.
    """
    expected = track.gender if track else None
    found = file_gender(path)
    if expected is not None and found is not None and expected != found:
        raise HoigsError(
            f"{key}: the clip's poses were fitted with the {expected} model, {path} is the {found} "
            f"one; give the {expected} file"
        )
