"""Checks of the clip folder's npz files: shapes, numbers, cameras, rotations and colours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from hoigs.core.clip_folder.diagnostics import FileDiagnostic, absent, wrong
from hoigs.core.clip_folder.format import FileSpec
from hoigs.core.diagnostics import ranges
from hoigs.core.files.npz import ArrayHeader, array_headers, load_arrays

ROTATION_TOLERANCE = 1e-3  # of R R^T - I, generous to float16 and text files
LARGEST = 1e7  # absolute value of any number: float32 has no centimetres left there
MOST_TEXT = 100_000


def check_arrays(
    folder: Path, path: str, spec: FileSpec, sizes: dict[str, int]
) -> tuple[list[FileDiagnostic], dict[str, np.ndarray]]:
    """Problems, and the arrays that are as they should be."""
    if not (folder / path).is_file():
        return [absent(path, spec.maker)], {}
    try:
        headers = array_headers(folder / path)
        problems = list(_header_problems(path, spec, headers, sizes))
        wanted = {a.name for a in spec.arrays} - {p.what.split(" ", 1)[0] for p in problems}
        arrays = load_arrays(folder / path, wanted)
    except (OSError, ValueError) as error:
        return [wrong(path, str(error))], {}
    good = {}
    for name, values in arrays.items():
        defect = _content_problem(values)
        if defect:
            problems.append(wrong(path, f"{name} {defect}"))
        else:
            good[name] = values
    return problems, good


def _header_problems(
    path: str, spec: FileSpec, headers: Mapping[str, ArrayHeader], sizes: dict[str, int]
) -> Iterator[FileDiagnostic]:
    """Absent arrays, and shapes and dtypes that are wrong; each message begins with a name."""
    for array in spec.arrays:
        if array.name in headers:
            defect = _array_problem(headers[array.name], array.shape, array.kind, sizes)
            if defect:
                yield wrong(path, f"{array.name} {defect}")
        elif not array.optional:
            yield wrong(path, f"has no array {array.name!r} ({array.meaning}); {spec.maker}")


def _array_problem(
    got: ArrayHeader, shape: tuple[int | str, ...], kind: str, sizes: dict[str, int]
) -> str | None:
    kinds = {"float": "f", "bool": "b", "str": "U"}
    if got.dtype.kind != kinds[kind]:
        return f"is {got.dtype}, expected {kind}"
    expected = [
        sizes.setdefault(s, n) if isinstance(s, str) else s for s, n in zip(shape, got.shape)
    ]
    if len(got.shape) != len(shape) or list(got.shape) != expected:
        named = ", ".join(f"{s}={sizes[s]}" if s in sizes else str(s) for s in shape)
        frames = bool(shape) and shape[0] == "F" and len(got.shape) == len(shape)
        count = f": {got.shape[0]} entries for {sizes['F']} frames" if frames else ""
        return f"has shape {list(got.shape)}, expected [{named}]{count}"
    if kind == "str" and got.nbytes > MOST_TEXT:
        return f"is a text of {got.nbytes} bytes, at most {MOST_TEXT} are read"
    return None


def _content_problem(got: np.ndarray) -> str | None:
    if got.dtype.kind != "f" or not got.size:
        return None
    bad = int((~np.isfinite(got)).sum())
    if bad:
        return f"has {bad} values that are NaN or infinite"
    largest = float(np.abs(got).max())
    if largest > LARGEST:
        return f"has values up to {largest:.3g}, at most {LARGEST:g} (metres, pixels) make sense"
    return None


def check_cameras(path: str, arrays: dict[str, np.ndarray]) -> Iterator[FileDiagnostic]:
    """Intrinsics without skew, focal lengths above zero, and rigid world_to_camera."""
    if "K" in arrays:
        K = arrays["K"]
        bad = (K[:, 0, 0] <= 0) | (K[:, 1, 1] <= 0) | (np.abs(K[:, 2] - [0, 0, 1]).max(-1) > 1e-5)
        bad |= (np.abs(K[:, 0, 1]) > 1e-3) | (np.abs(K[:, 1, 0]) > 1e-3)
        if bad.any():
            form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0"
            yield wrong(path, f"K of {_frames(bad)} is not {form}")
    if "world_to_camera" in arrays:
        w2c = arrays["world_to_camera"]
        yield from _check_rotations(path, "world_to_camera", w2c[:, :3, :3])
        bad = np.abs(w2c[:, 3] - [0, 0, 0, 1]).max(-1) > 1e-5
        if bad.any():
            yield wrong(path, f"world_to_camera of {_frames(bad)}: last row is not 0 0 0 1")


def _check_rotations(path: str, name: str, rotations: np.ndarray) -> Iterator[FileDiagnostic]:
    R = rotations.astype(np.float64)
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    bad = (off > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    if bad.any():
        message = f"{name} of {_frames(bad)} is not a rotation (orthonormal, determinant +1)"
        yield wrong(path, f"{message}; largest |R R^T - I| is {off.max():.3g}")


def _frames(bad: np.ndarray) -> str:
    numbers = np.flatnonzero(bad).tolist()
    return f"frame {numbers[0]}" if len(numbers) == 1 else (
        f"{len(numbers)} frames ({ranges(numbers)})")  # fmt: skip


def check_colors(path: str, arrays: dict[str, np.ndarray]) -> Iterator[FileDiagnostic]:
    """Points with colours in [0, 1]."""
    if "points" in arrays and len(arrays["points"]) == 0:
        yield wrong(path, "points is empty; at least one point is needed to start from")
    colors = arrays.get("colors")
    if colors is not None and len(colors) and (colors.min() < 0 or colors.max() > 1):
        spread = f"{colors.min():.3g}..{colors.max():.3g}"
        yield wrong(path, f"colors span {spread}, expected RGB in [0, 1]; divide bytes by 255")


def check_track(
    path: str, arrays: dict[str, np.ndarray], body: str | None
) -> Iterator[FileDiagnostic]:
    """A body's or an object's track; `body` is the model that clip.json names for it."""
    if "rotations" in arrays:
        yield from _check_rotations(path, "rotations", arrays["rotations"])
    yield from check_colors(path, arrays)
    if "observed" in arrays and not arrays["observed"].any():
        yield wrong(path, "observed is False in every frame: the object was never seen")
    convention = str(arrays.get("hand_pose_convention", "flat"))
    if convention not in ("flat", "mean"):
        yield wrong(path, f'hand_pose_convention is {convention!r}, expected "flat" or "mean"')
    if body and "model" in arrays and str(arrays["model"]) != body:
        yield wrong(path, f"model is {arrays['model']!s}, but clip.json has {body}")
