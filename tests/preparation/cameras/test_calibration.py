"""Lenses from calibrations of several tools, and frames that lose their distortion."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from test_cameras import colmap_model
from tiny import FRAMES, HEIGHT, WIDTH

from hoigs.core.errors import SpecError
from hoigs.core.values.lens import Lens
from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.cameras.calibration import fitting, given_intrinsics, read_calibration
from hoigs.preparation.cameras.choose import BesideVideo, choose_cameras
from hoigs.preparation.estimates.installed import load_options
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.frames import VideoFrames
from hoigs.preparation.video.source import SourceError

SIZE = (1920, 1080)
PARAMS = (1500.0, 1510.0, 959.5, 539.5, -0.1, 0.02, 0.001, -0.002)  # OpenCV's, pixel 0 at (0, 0)
LENS = Lens("OPENCV", (1500.0, 1510.0, 960.0, 540.0, *PARAMS[4:]), *SIZE)
OPENCV = """%YAML:1.0
---
calibration_time: "today"
image_width: 1920
image_height: 1080
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1500., 0., 959.5, 0., 1510., 539.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.1, 0.02, 0.001, -0.002, 0. ]
"""
XML = """<?xml version="1.0"?>
<opencv_storage><image_width>1920</image_width><image_height>1080</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>
 1500. 0. 959.5 0. 1510. 539.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>4</cols><dt>d</dt>
<data>-0.1 0.02 0.001 -0.002</data></distortion_coefficients></opencv_storage>
"""
QUALISYS = f"""<calibration><cameras><camera active="1" serial="26580" viewrotation="0">
<fov_video left="0" top="0" right="1919" bottom="1079"/><transform x="1"/>
<intrinsic focallength="9.2" sensorMinU="0" sensorMaxU="122879" sensorMinV="0" sensorMaxV="69631"
 focalLengthU="{1500 * 64}" focalLengthV="{1510 * 64}" centerPointU="{959.5 * 64}"
 centerPointV="{539.5 * 64}" skew="0" radialDistortion1="-0.1" radialDistortion2="0.02"
 radialDistortion3="0" tangentalDistortion1="0.001" tangentalDistortion2="-0.002"/>
</camera></cameras></calibration>
"""
POSE2SIM = """[cam_01]
name = "cam_01"
size = [ 1920.0, 1080.0]
matrix = [ [ 1500.0, 0.0, 959.5], [ 0.0, 1510.0, 539.5], [ 0.0, 0.0, 1.0]]
distortions = [ -0.1, 0.02, 0.001, -0.002]
rotation = [ 0.9, 0.5, 0.1]
translation = [ 1.0, 0.1, 4.0]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""
COLMAP = "# Camera list\n1 OPENCV 1920 1080 1500 1510 960 540 -0.1 0.02 0.001 -0.002\n"
BINARY = struct.pack("<QiiQQ8d", 1, 1, 4, *SIZE, *LENS.params)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (OPENCV, "OpenCV's YAML"), (XML, "OpenCV's XML"), (QUALISYS, "Qualisys"),
        (POSE2SIM, "Pose2Sim's TOML"), (COLMAP, "cameras.txt"), (BINARY, "cameras.bin"),
    ],
)  # fmt: skip
def test_a_file_is_known_by_its_content(content: str | bytes, what: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.dat"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    lens, described = read_calibration(str(path), (640, 360))
    assert what in described
    assert (lens.model, lens.width, lens.height) == ("OPENCV", *SIZE)
    assert lens.params == pytest.approx(LENS.params)


def test_one_of_several_cameras_is_named(tmp_path: Path) -> None:
    path = tmp_path / "calib.toml"
    second = POSE2SIM.partition("[metadata]")[0].replace("01", "02").replace("1500", "1600")
    path.write_text(POSE2SIM + second)
    with pytest.raises(SourceError, match=r"cam_01, cam_02.*calib\.toml#cam_01"):
        read_calibration(str(path), SIZE)
    assert read_calibration(f"{path}#cam_02", SIZE)[0].params[0] == 1600
    with pytest.raises(SourceError, match="cam_01, cam_02"):
        read_calibration(f"{path}#cam_03", SIZE)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("hello", "COLMAP"),
        ("1 NO_SUCH 3 4 5\n", "NO_SUCH"),
        (BINARY[:-3], "calibration.dat"),
        (XML.replace("data>", "dat>"), "calibration.dat"),
        (XML.replace("<?xml", "<!DOCTYPE x><?xml"), "entities"),
        (QUALISYS.replace('viewrotation="0"', 'viewrotation="90"'), "90"),
        (OPENCV.replace("0., 0., 1. ]", "0., 1. ]"), "calibration.dat"),
        (b"\0\1\2", "calibration.dat"),
    ],
)
def test_files_that_are_none(content: str | bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.dat"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SourceError, match=message):
        read_calibration(str(path), SIZE)


def test_sizes_have_to_agree() -> None:
    assert fitting(LENS, (960, 540), "it").params[:4] == (750, 755, 480, 270)
    with pytest.raises(SourceError, match=r"1920x1080 .* 1080x1920.*turned"):
        fitting(LENS, (1080, 1920), "it")
    with pytest.raises(SourceError, match=r"1920x1080 .* 640x480.*shape"):
        fitting(LENS, (640, 480), "it")
    with pytest.raises(SourceError, match=r"5000, 2"):
        fitting(given_intrinsics((1500, 1500, 5000, 2), SIZE), SIZE, "it")
    with pytest.raises(SpecError, match=r"3 .*fx,fy,cx,cy"):
        load_options(flags={"intrinsics": "1,2,3"})
    with pytest.raises(SpecError, match="focal and calibration"):
        load_options(flags={"focal": 3.0, "calibration": "x"})


def test_a_still_cameras_frames_are_undistorted(tiny_video: Path, tmp_path: Path) -> None:
    unseen = np.full((FRAMES, 33, 4), np.nan)
    nothing = [np.zeros((HEIGHT // 2, WIDTH // 2), bool)] * FRAMES
    everything = Landmarks.from_mediapipe(unseen, unseen), GivenMasks(human=MaskStack(nothing))
    options = load_options(
        flags={"camera": "static", "intrinsics": f"90,92,{WIDTH / 2 - 0.5},{HEIGHT / 2},-0.3,0,0,0"}
    )
    video = VideoFrames(tiny_video, width=WIDTH // 2)

    def choose(options: PrepareOptions, model: Path | None = None):
        return choose_cameras(
            video, *everything, BesideVideo(model), options, tmp_path, lambda _: None
        )

    track = choose(options).track
    K = track.cameras[0].K
    assert (K[0, 0], K[1, 1], K[0, 2]) == (45, 46, WIDTH / 4)
    assert (
        track.static and track.figures["distortion_px"] > 1 and "--intrinsics" in track.provenance
    )
    # by COLMAP's own model of such a lens
    same = Lens("OPENCV", (90, 92, WIDTH / 2, HEIGHT / 2 + 0.5, -0.3, 0, 0, 0), WIDTH, HEIGHT)
    image = next(iter(video))
    expected = same.undistortion((video.width, video.height)).image(image)
    assert (track.undistort.image(image) == expected).all() and (expected != image).any()
    moving = options.model_copy(update={"camera": "auto"})
    with pytest.raises(SourceError, match=r"sparse.*--intrinsics"):
        choose(moving, colmap_model(tmp_path / "sparse"))
