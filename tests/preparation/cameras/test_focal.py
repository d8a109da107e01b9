"""A still camera's focal length: the file's, the person's if that is clear, or a usual one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny import FRAMES, landmarks, picture

from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.cameras.focal import (
    LONGEST,
    SHORTEST,
    FocalCurve,
    focal_curve,
    focal_of_metadata,
    static_focal,
)
from hoigs.preparation.video.frames import VideoFrames, open_frames

WIDTH, HEIGHT = 1280, 720
PERSON = landmarks()["world_xyzv"][0, :, :3].astype(np.float64)


def seen(
    focal: float, distance: float, *, noise: float = 1.0, frames: int = 40, depth: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Image and world landmarks of someone who moves limbs and turns before a known camera.

    Args:
        focal: in image widths. noise: of the image, pixels. depth: 0 flattens the person.
    """
    dice = np.random.default_rng(0)
    limbs = PERSON + 0.1 * dice.normal(size=(frames, 33, 3))
    turns = Rotation.from_rotvec(dice.normal(size=(frames, 3)) * (0.1, 0.8, 0.1)).as_matrix()
    world = limbs @ turns.transpose(0, 2, 1) * (1, 1, depth)
    places = dice.uniform((-0.4, -0.1, 0.85), (0.4, 0.1, 1.15), (frames, 3)) * (1, 1, distance)
    points = world + places[:, None]
    xy = points[..., :2] / points[..., 2:] * focal * WIDTH + (WIDTH / 2, HEIGHT / 2)
    xy += noise * dice.normal(size=xy.shape)
    xy[:, 3] += 60  # a landmark that is always wrong
    return np.concatenate((xy, np.ones((frames, 33, 1))), -1), world


@pytest.mark.parametrize("focal", [0.7, 0.95, 1.3])
def test_a_known_camera_is_found(focal: float) -> None:
    image, world = seen(focal, 2.5)
    image[4] = np.nan  # nobody was found there
    world[7, 20:] = np.nan
    curve = focal_curve(image, world, (WIDTH, HEIGHT))
    assert curve is not None and curve.distinct, curve
    assert curve.best == pytest.approx(focal, rel=0.1)
    low, high = curve.range
    assert low <= focal * 1.03 and high >= focal / 1.03 and high / low < 1.36


def test_far_and_flat_people_say_nothing() -> None:
    for image, world in (seen(0.8, 25.0, noise=2.0), seen(0.8, 3.0, depth=0.0)):
        curve = focal_curve(image, world, (WIDTH, HEIGHT))
        assert curve is not None and not curve.distinct
    image, world = seen(0.8, 2.5, frames=4)
    assert focal_curve(image, world, (WIDTH, HEIGHT)) is None


def test_what_makes_a_minimum_distinct() -> None:
    focals = np.geomspace(SHORTEST, LONGEST, 29)
    sharp = 1 + 8 * np.log(focals / 0.9) ** 2
    assert FocalCurve(focals, sharp, (0.9, 0.92)).distinct
    assert FocalCurve(focals, sharp, (0.9, 0.9)).best == pytest.approx(0.9, rel=0.01)
    assert not FocalCurve(focals, sharp, (0.7, 0.92)).distinct, "halves that disagree"
    assert not FocalCurve(focals, 1 + 0.1 * (sharp - 1), (0.9, 0.9)).distinct, "flat"
    falling = FocalCurve(focals, 2 - np.log(focals), (2.0, 2.0))
    assert falling.best == LONGEST and not falling.distinct


def test_which_focal_length_is_taken(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video)
    wide = video.native_width
    image, world = seen(1.1, 2.5)
    scale = np.array((wide / WIDTH,) * 2)
    center = np.array((wide, video.native_height)) / 2
    raw = np.zeros((len(image), 33, 4))
    raw[..., :2] = (image[..., :2] - (WIDTH / 2, HEIGHT / 2)) * scale + center
    raw[..., 3] = 1
    space = np.concatenate((world, np.ones((*world.shape[:2], 1))), -1)
    assert static_focal(video, Landmarks.from_mediapipe(raw, space), 70.0).how == "given"
    found = static_focal(video, Landmarks.from_mediapipe(raw, space), None)
    assert found.pixels == pytest.approx(1.1 * wide, rel=0.1) and "estimated" in found.how
    assert "estimated from the person" in found.warnings[0]
    assert found.figures["focal_low_px"] < found.pixels < found.figures["focal_high_px"]
    flat = static_focal(video, Landmarks.from_mediapipe(raw, space * np.nan), None)
    assert flat.pixels == 0.8 * wide and "assumed" in flat.how
    assert "too few landmarks are known in space" in flat.warnings[0]
    still = landmarks()
    alike = Landmarks.from_mediapipe(still["image_xyzv"] + 0.3, still["world_xyzv"] * (1, 1, 0, 1))
    assert "explain them equally well" in static_focal(video, alike, None).warnings[0]


def test_what_files_say(tmp_path: Path) -> None:
    import av

    path = tmp_path / "phone.mov"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = "26"
        stream = container.add_stream("libx264", rate=12)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(picture(i), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    found = focal_of_metadata(path, 96, 64)
    assert found is not None
    assert found[0] == pytest.approx(26 / 43.267 * np.hypot(96, 64), rel=1e-3)
    assert "26 mm on 35 mm film" in found[1]
    nobody = np.full((FRAMES, 33, 4), np.nan)
    chosen = static_focal(VideoFrames(path), Landmarks.from_mediapipe(nobody, nobody), None)
    assert chosen.pixels == found[0] and "focal_length.35mm_equivalent" in chosen.how
    photos = tmp_path / "photos"
    photos.mkdir()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.fromarray(picture(0)).save(photos / "0.jpg", exif=exif)
    Image.fromarray(picture(1)).save(photos / "1.jpg")
    of_photo = focal_of_metadata(photos, 96, 64)
    assert of_photo is not None and of_photo[0] == pytest.approx(74.66, abs=0.05)
    Image.fromarray(picture(0)).save(photos / "0.jpg")
    assert focal_of_metadata(photos, 96, 64) is None
    assert open_frames(photos).native_width == 96
