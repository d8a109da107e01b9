"""Cameras from the video itself: COLMAP's structure from motion on what does not move."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hoigs.core.reporting import ranges
from hoigs.core.values.lens import Lens
from hoigs.preparation.cameras.camera_track import ASSUMED_FOCAL
from hoigs.preparation.cameras.focal import USUAL
from hoigs.preparation.cameras.turning_cameras import grown, quiet_colmap
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.source import SourceError

LENS = "SIMPLE_RADIAL"  # one focal length, one distortion: a video determines no more
FEATURES = 8192  # of an image
OVERLAP = 10  # frames that each is matched with, and as many at distances 1, 2, 4, 8, …
WIDEST = 0.33  # focal length, in longer sides: a view of 113 degrees
FURTHER = (1.15, 1.6, 0.55)  # focal lengths, in longer sides, after ASSUMED_FOCAL
SMALLEST_SHARE = 0.5  # of the frames: with fewer cameras there is no clip
SHORTEST = 0.5  # seconds of a part of the video that is worth a clip
SAME = 1.05  # ratio of the focal lengths of two starts up to which the one confirms the other
FEWEST = 10  # cameras of a half of the video that is adjusted by itself
ITERATIONS = 40


@dataclass(frozen=True)
class FromMotion:
    """A COLMAP model, and how well the video determines its focal length.

    Attributes:
        model: its folder; its images are named by frame number.
        focals: shortest and longest focal length, in pixels of the frames, that two starts and the
            halves of the video give, with the usual ones if it is not confirmed; None where there
            is but one, or the lens is calibrated.
        confirmed: another start led to the same focal length, or it was given.
    """

    model: Path
    focals: tuple[float, float] | None
    confirmed: bool


def structure_from_motion(
    video: Frames,
    masks: GivenMasks,
    folder: Path,
    *,
    focal: float | None = None,
    lens: Lens | None = None,
    progress: Callable[[float], None] | None = None,
) -> FromMotion:
    """A COLMAP model of the chosen frames, the largest that was found.

    COLMAP verifies pairs of images with the focal length at the start, and a bad guess leaves no
    pair; so several are tried until half of the frames have a camera. A camera that turns more than
    it travels is explained by several focal lengths, each with cameras of its own: what was found
    is sought once more from the start that is farthest from it, of those that were not tried yet.

    Features on masked pixels are left out; frames are matched with their neighbours in time; one
    camera with one radial distortion serves all (COLMAP, Schoenberger and Frahm 2016).

    Args:
        folder: to work in; images, databases and models are left there. Features and matches
            that an earlier run of the same frames and masks left are used again.
        focal: pixels of the frames' size, if known; it is still refined.
        lens: of the video, if calibrated; it is not refined.
        progress: called with 0..1.

    Raises:
        SourceError: less than half of the frames were given a camera, and why that may be.
    """
    from hoigs.core.system.colmap import pycolmap

    report = progress or (lambda _done: None)
    images, features = folder / "images", folder / "features.db"
    for name in ("images", "masks", "models", "largest"):  # cheap, or half-made
        shutil.rmtree(folder / name, ignore_errors=True)
    _write_images(video, masks, folder, lambda done: report(0.1 * done))
    longer = max(video.width, video.height)
    if lens is not None:
        lens = lens.resized(video.width, video.height)
        focal = float(lens.K[0, 0])
    tried = [focal] if focal else [share * longer for share in (ASSUMED_FOCAL, *FURTHER)]
    enough, found = SMALLEST_SHARE * len(video), list[Any]()
    with quiet_colmap():
        if not features.is_file():
            _extract(pycolmap, features, images, _reader(pycolmap, video, folder, tried[0], lens))

        def started(number: int) -> Any:
            """The model from one of the focal lengths, or None."""
            begun = 0.4 + 0.6 * number / (len(tried) + 1)
            report(begun)
            matches = folder / f"matches-{number}.db"
            if not matches.is_file():
                _match(pycolmap, features, matches, None if lens else tried[number])
            report(begun + 0.3 / (len(tried) + 1))
            return _mapped(pycolmap, matches, images, folder / "models" / str(number), lens)

        left = [*range(len(tried))]
        while left:
            model = started(left.pop(0))
            found += [] if model is None else [model]
            if model is not None and model.num_reg_images() >= enough:
                break
        best = max(found, key=lambda m: m.num_reg_images(), default=None)
        if best is None or best.num_reg_images() < enough:
            raise SourceError(_too_few(best, video, tried))
        models, known = [best], lens is not None or focal is not None
        if left and not known:  # a start that failed before confirms nothing
            again = started(max(left, key=lambda n: _ratio(tried[n], _focal(best))))
            models += [again] if again and again.num_reg_images() >= enough else []
        confirmed = known or (len(models) > 1 and _ratio(*map(_focal, models)) <= SAME)
        if not confirmed:
            best = max(models, key=lambda m: (m.num_reg_images(), m.compute_num_observations()))
        usual = None if confirmed else (USUAL[0] * longer, USUAL[1] * longer)
        focals = None if lens else _focals(pycolmap, best, models, usual)
    kept = folder / "largest"
    kept.mkdir()
    best.write(kept)
    report(1.0)
    return FromMotion(kept, focals, confirmed)


def _too_few(best: Any, video: Frames, tried: list[float]) -> str:
    lengths = ", ".join(f"{length:.0f}" for length in tried)
    count = 0 if best is None else best.num_reg_images()
    return (
        f"structure from motion gave cameras to {count} of {len(video)} frames, with focal "
        f"lengths of {lengths} px to start from. {_what_to_do(best, video)}if the camera "
        "stands still, use --camera static, and if it hardly changes its place, as in a hand, "
        "--camera turning; if you know the lens, give --focal or "
        "--calibration; else the background may lack texture, be blurred or be hidden by the "
        "masks: look at the masks, take sharper or more frames, or put a COLMAP model of your "
        "own beside the video, as sparse/"
    )


def _write_images(
    video: Frames, masks: GivenMasks, folder: Path, report: Callable[[float], None]
) -> None:
    """images/00017.png by frame number, and masks/00017.png.png, 0 where nothing is to be found."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for i, (number, image) in enumerate(zip(video.indices, video, strict=True)):
        name = f"{number:05d}.png"
        Image.fromarray(image).save(folder / "images" / name, compress_level=1)
        still = np.where(grown(masks.moving(i)), 0, 255).astype(np.uint8)
        Image.fromarray(still).save(folder / "masks" / f"{name}.png", compress_level=1)
        report((i + 1) / len(video))


def _extract(pycolmap: Any, features: Path, images: Path, reader: Any) -> None:
    """A database with the features of all images; it appears under its name when it is whole."""
    half = _copy(None, features)
    pycolmap.extract_features(
        half,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=_extraction(pycolmap),
        device=pycolmap.Device.cpu,
    )
    half.replace(features)


def _match(pycolmap: Any, features: Path, matches: Path, focal: float | None) -> None:
    """A database with features, and matches that hold for a focal length (None: that of the
    database), likewise."""
    half = _copy(features, matches)
    database = pycolmap.Database.open(half)
    for camera in database.read_all_cameras():
        if focal is not None:
            camera.focal_length = focal
            database.update_camera(camera)
    database.close()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0  # else each run has other matches, and other cameras
    pycolmap.match_sequential(
        half,
        matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=_threads()),
        pairing_options=pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True),
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )
    half.replace(matches)


def _mapped(pycolmap: Any, matches: Path, images: Path, folder: Path, lens: Lens | None) -> Any:
    """The reconstruction with the most cameras, or None."""
    folder.mkdir(parents=True)
    models = pycolmap.incremental_mapping(
        _copy(matches), images, folder, options=_mapping(pycolmap, lens is not None)
    )
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def _focal(model: Any) -> float:
    """Focal length of a model's one camera, pixels."""
    return float(next(iter(model.cameras.values())).params[0])


def _ratio(a: float, b: float) -> float:
    return max(a, b) / min(a, b)


def _focals(
    pycolmap: Any, best: Any, models: list[Any], usual: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Shortest and longest focal length: of all models, of the halves of the best one's frames,
    each adjusted by itself, and of what is `usual`."""
    lengths = [*map(_focal, models), *(usual or ())]
    rows = sorted(
        (i for i, m in best.images.items() if m.has_pose), key=lambda i: best.image(i).name
    )
    half = len(rows) // 2
    if half >= FEWEST:
        lengths += [_adjusted_focal(pycolmap, best, part) for part in (rows[:half], rows[half:])]
    return (min(lengths), max(lengths)) if len(lengths) > 1 else None


def _adjusted_focal(pycolmap: Any, model: Any, rows: list[int]) -> float:
    """The focal length after a bundle adjustment of some images alone."""
    copy = pycolmap.Reconstruction(model)
    for image in copy.images.values():
        if image.has_pose and image.image_id not in rows:
            copy.deregister_frame(image.frame_id)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.num_threads = _threads()
    pycolmap.bundle_adjustment(copy, options)
    return _focal(copy)


def _what_to_do(model: Any, video: Frames) -> str:
    """The frames that have a camera, and how to use their longest part if it is of any use."""
    if model is None:
        return "To go on: "
    known = sorted(int(Path(image.name).stem) for image in model.images.values())
    order = {number: place for place, number in enumerate(video.indices)}
    runs = [known[:1]]
    for number in known[1:]:
        if order[number] == order[runs[-1][-1]] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    longest = max(runs, key=len)
    seconds = video.times[order[longest[-1]]] - video.times[order[longest[0]]]
    said = f"Frames {ranges(known)} of the video have one"
    if seconds >= SHORTEST:
        said += (
            f"; --start {longest[0]}f --end {longest[-1] + 1}f uses the longest part of them, "
            f"{seconds:.1f} s"
        )
    return f"{said}. To have more: "


def _copy(database: Path | None, name: Path | None = None) -> Path:
    """A temporary database for `name`, or beside `database`: a copy of it, or none yet.

    What a killed run left of it goes, with SQLite's own files beside it.
    """
    target = name or database
    assert target is not None
    half = target.with_suffix(".part")
    for path in target.parent.glob(f"{half.name}*"):
        path.unlink()
    if database is not None:
        shutil.copyfile(database, half)
    return half


def _reader(
    pycolmap: Any, video: Frames, folder: Path, focal: float | None, lens: Lens | None
) -> Any:
    f = focal or ASSUMED_FOCAL * max(video.width, video.height)
    options = pycolmap.ImageReaderOptions(mask_path=str(folder / "masks"), camera_model=LENS)
    options.camera_params = f"{f},{video.width / 2},{video.height / 2},0"
    if lens is not None:
        options.camera_model = lens.model
        options.camera_params = ",".join(map(repr, lens.params))
    return options


def _extraction(pycolmap: Any) -> Any:
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=_threads())
    options.sift.max_num_features = FEATURES
    return options


def _mapping(pycolmap: Any, calibrated: bool) -> Any:
    options = pycolmap.IncrementalPipelineOptions(num_threads=_threads(), random_seed=0)
    # a video adds its frames in order: the whole need not be solved anew after every tenth
    options.ba_refine_focal_length = options.ba_refine_extra_params = not calibrated
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    options.min_focal_length_ratio = WIDEST  # such a view is a wrong turn: another start is tried
    return options


def _threads() -> int:
    """The number that OMP_NUM_THREADS gives, else one a core."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdigit() and int(given) else os.cpu_count() or 1
