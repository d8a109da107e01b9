"""Lenses from calibrations: COLMAP's cameras, OpenCV's FileStorage, Qualisys, Pose2Sim's TOML.

A file is recognised by its content, whatever its name.
"""

from __future__ import annotations

import re
import struct
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from hoigs.core.errors import ClipError
from hoigs.core.values.lens import Lens
from hoigs.preparation.video.source import SourceError

EXPECTED = (
    "expected COLMAP's cameras.txt or cameras.bin, OpenCV's or ROS's camera_matrix and "
    "distortion_coefficients in YAML or XML, a Qualisys calibration, or a TOML of Pose2Sim"
)
SUBPIXELS = 64  # in which Qualisys writes pixels
LARGEST_SIDE = 20_000  # pixels: a larger sensor is in subpixels
LARGEST_FILE = 10_000_000  # bytes
_COLMAP_LINE = re.compile(r"^\s*\d+\s+[A-Z_]+\s+\d+\s+\d+\s+[-+\d.eE\s]+$")
FISHEYES = ("fisheye", "equidistant")  # OpenCV's and ROS's names for one model
Lenses = dict[str, Lens]


def read_calibration(text: str, video_size: tuple[int, int]) -> tuple[Lens, str]:
    """The lens in a file, and what it was read as.

    Args:
        text: path of the file; PATH#NAME where it holds several cameras.
        video_size: width and height, for files that do not hold theirs.

    Raises:
        SourceError: there is no such file, or it cannot be read, or holds several cameras.
    """
    path, name = calibration_file(text)
    if not path.is_file():
        raise SourceError(f"--calibration: there is no file {path}")
    if path.stat().st_size > LARGEST_FILE:
        raise SourceError(f"--calibration: {path} is no calibration: {path.stat().st_size} bytes")
    try:
        what, lenses = _lenses(path.read_bytes(), video_size)
    except (ClipError, ValueError, KeyError, IndexError, TypeError, struct.error,
            ElementTree.ParseError, yaml.YAMLError) as error:  # fmt: skip
        raise SourceError(f"--calibration: {path} cannot be read: {error}; {EXPECTED}") from error
    if not lenses:
        raise SourceError(f"--calibration: {path} holds no camera; {EXPECTED}")
    if not name and len(lenses) > 1 and len(set(lenses.values())) == 1:
        name = next(iter(lenses))
    if name not in lenses and (name or len(lenses) > 1):
        raise SourceError(
            f"--calibration: {path} holds {', '.join(lenses)}; name the one that filmed the video, "
            f"such as --calibration {path}#{next(iter(lenses))}"
        )
    return lenses[name or next(iter(lenses))], f"{path.name}, {what}"


def calibration_file(text: str) -> tuple[Path, str]:
    """The path in PATH or PATH#NAME, and the name or ""."""
    path = Path(text)
    if path.is_file() or "#" not in text:
        return path, ""
    head, _, name = text.rpartition("#")
    return Path(head), name


def given_intrinsics(values: tuple[float, ...], video_size: tuple[int, int]) -> Lens:
    """A lens from fx, fy, cx, cy and perhaps k1, k2, p1, p2, pixels of the video.

    They are OpenCV's, which puts the centre of the top-left pixel at (0, 0).
    """
    fx, fy, cx, cy = values[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
    return Lens.opencv(K, values[4:], *video_size, pixel_center=0.0)


def fitting(lens: Lens, size: tuple[int, int], where: str) -> Lens:
    """The lens for frames of another size, if they may be its picture.

    Raises:
        SourceError: the frames have another shape, or the principal point lies outside of them.
    """
    width, height = size
    if abs(lens.width * height - lens.height * width) > max(lens.width, lens.height, width):
        turned = lens.width * width == lens.height * height
        raise SourceError(
            f"{where} is of {lens.width}x{lens.height} pixels, the video's frames are "
            f"{width}x{height}: "
            + (
                "they are turned; calibrate with the camera held as in the video"
                if turned
                else "another shape; calibrate with the mode that the video was filmed in"
            )
        )
    K = lens.K
    inside = 0 < K[0, 2] < lens.width and 0 < K[1, 2] < lens.height
    if not (np.isfinite(lens.params).all() and inside and K[0, 0] > 0 < K[1, 1]):
        raise SourceError(
            f"{where}: focal lengths {K[0, 0]:.0f}, {K[1, 1]:.0f} and principal point "
            f"{K[0, 2]:.0f}, {K[1, 2]:.0f} cannot be of {lens.width}x{lens.height} pixels; the "
            "focal lengths are in pixels, and the point lies near the middle"
        )
    return lens.resized(width, height)


def _lenses(content: bytes, size: tuple[int, int]) -> tuple[str, Lenses]:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        return "COLMAP's cameras.bin", _colmap_binary(content)
    if text.lstrip().startswith("<"):
        return _xml(text, size)
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    if lines and all(_COLMAP_LINE.match(line) for line in lines):
        return "COLMAP's cameras.txt", _colmap_text(lines)
    try:
        return "Pose2Sim's TOML", _pose2sim(tomllib.loads(text))
    except tomllib.TOMLDecodeError:
        return "OpenCV's YAML", _opencv_yaml(text, size)


def _colmap_text(lines: list[str]) -> Lenses:
    rows = [line.split() for line in lines]
    return {r[0]: Lens(r[1], tuple(map(float, r[4:])), int(r[2]), int(r[3])) for r in rows}


def _colmap_binary(content: bytes) -> Lenses:
    from hoigs.core.system.colmap import pycolmap

    (count,), at = struct.unpack_from("<Q", content), 8
    found: Lenses = {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", content, at)
        name = pycolmap.CameraModelId(model).name
        named = pycolmap.Camera(model=name, width=1, height=1).params_info.split(",")
        params = struct.unpack_from(f"<{len(named)}d", content, at + 24)
        at += 24 + 8 * len(named)
        found[str(number)] = Lens(name, params, width, height)
    if at != len(content):
        raise ValueError(f"{len(content) - at} bytes are left behind {count} cameras")
    return found


def _pose2sim(document: Mapping[str, Any]) -> Lenses:
    tables = {k: v for k, v in document.items() if isinstance(v, dict) and "matrix" in v}
    return {
        str(table.get("name", key)): _opencv(
            table["matrix"], table.get("distortions", ()), table["size"],
            fisheye=bool(table.get("fisheye", False)),
        )
        for key, table in tables.items()
    }  # fmt: skip


class _Storage(yaml.SafeLoader):
    """YAML with OpenCV's matrices as plain mappings."""


_Storage.add_multi_constructor(
    "tag:yaml.org,2002:opencv", lambda loader, _tag, node: loader.construct_mapping(node, deep=True)
)


def _opencv_yaml(text: str, size: tuple[int, int]) -> Lenses:
    if text.startswith("%YAML"):  # OpenCV's first line, "%YAML:1.0", is not YAML
        text = text.partition("\n")[2]
    document = yaml.load(text, Loader=_Storage)
    return _storage(document if isinstance(document, dict) else {}, size)


def _xml(text: str, size: tuple[int, int]) -> tuple[str, Lenses]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares XML entities, which no calibration needs")
    root = ElementTree.fromstring(text)
    if root.tag != "opencv_storage":
        return "Qualisys", _qualisys(root)
    plain: dict[str, Any] = {}
    for child in root:
        data = child.find("data")
        plain[child.tag] = child.text if data is None else {"data": (data.text or "").split()}
    return "OpenCV's XML", _storage(plain, size)


def _storage(document: Mapping[str, Any], size: tuple[int, int]) -> Lenses:
    """What OpenCV's and ROS's calibrations call their values."""

    def first(*names: str) -> Any:
        return next((document[n] for n in names if n in document), None)

    matrix = first("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")
    if matrix is None:
        return {}
    distortion = first(
        "distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D"
    )
    model = str(first("distortion_model", "model") or "")
    fisheye = model.lower() in FISHEYES or str(first("fisheye_model") or "0").strip() == "1"
    own = first("image_width", "width", "image_Width"), first("image_height", "height")
    shape = size if None in own else own
    return {"camera": _opencv(_numbers(matrix), _numbers(distortion), shape, fisheye=fisheye)}


def _numbers(value: Any) -> list[float]:
    data = value["data"] if isinstance(value, dict) else value
    return [float(x) for x in np.ravel(data if data is not None else [])]


def _opencv(matrix: Any, distortion: Any, size: Any, *, fisheye: bool = False) -> Lens:
    K = np.asarray(matrix, np.float64).reshape(3, 3)
    numbers = [float(x) for x in distortion]
    while len(numbers) > 8 and not numbers[-1]:
        numbers.pop()  # thin prisms and tilts that are not there
    width, height = (round(float(x)) for x in size)
    if not fisheye:
        return Lens.opencv(K, numbers, width, height, pixel_center=0.0)
    params = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *(numbers or [0.0] * 4))
    return Lens("OPENCV_FISHEYE", tuple(float(p) for p in params), width, height)


def _qualisys(root: ElementTree.Element) -> Lenses:
    found: Lenses = {}
    for camera in root.iter("camera"):
        inside = camera.find("intrinsic")
        if inside is None:
            continue
        name = str(camera.get("serial", len(found)))
        if float(camera.get("viewrotation", 0)) % 360:
            raise ValueError(
                f"the picture of camera {name} is turned by {camera.get('viewrotation')} degrees "
                "against its calibration, which is not supported; give --intrinsics"
            )
        found[name] = _qualisys_lens(inside, camera.find("fov_video"))
    return found


def _qualisys_lens(inside: ElementTree.Element, cut: ElementTree.Element | None) -> Lens:
    def value(name: str) -> float:
        return float(inside.get(name, 0))

    sides = [value(f"sensorMax{axis}") - value(f"sensorMin{axis}") for axis in "UV"]
    unit = SUBPIXELS if max(sides) > LARGEST_SIDE else 1
    width, height = (round(side / unit) for side in sides)
    fx, fy, cx, cy = (
        value(n) / unit for n in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    if cut is not None:  # the part of the sensor that a video shows
        left, top, right, bottom = (
            float(cut.get(n, 0)) for n in ("left", "top", "right", "bottom")
        )
        width, height = round(right - left) + 1, round(bottom - top) + 1
        cx, cy = cx - left, cy - top
    names = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1",
             "tangentalDistortion2", "radialDistortion3")  # fmt: skip
    return _opencv(
        [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], [value(n) for n in names], (width, height)
    )
