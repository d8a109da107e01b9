"""MegaSaM's npz beside a video: cameras, and points of what stands still."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.preparation.cameras.known import megasam_cameras
from hoigs.preparation.video.source import SourceError, find_source
from tests.preparation.tiny import FRAMES, HEIGHT, WIDTH

FOCAL, WALL, NEAR = 500.0, 4.0, 2.0


def arrays(frames: int = FRAMES) -> dict[str, np.ndarray]:
    """A camera goes right along a wall, something before it left."""
    grown = (384 * 512 / (WIDTH * HEIGHT)) ** 0.5
    width, height = int(WIDTH * grown) // 8 * 8, int(HEIGHT * grown) // 8 * 8
    depths = np.full((frames, height, width), WALL, np.float16)
    images = np.full((frames, height, width, 3), 60, np.uint8)
    back = np.tile(np.eye(4), (frames, 1, 1))
    back[:, 0, 3] = 0.05 * np.arange(frames)
    for i in range(frames):
        left = width - 120 - 30 * i
        depths[i, 50:150, left : left + 100] = NEAR
        images[i, 50:150, left : left + 100] = 255
    K = np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]])
    return {"images": images, "depths": depths, "intrinsic": K, "cam_c2w": back}


def test_cameras_at_the_chosen_width_and_points_of_the_wall_alone(tmp_path, video):
    np.savez(tmp_path / "clip_sgd_cvd_hr.npz", **arrays())
    track = megasam_cameras(video, tmp_path / "clip_sgd_cvd_hr.npz")
    grown = (384 * 512 / (WIDTH * HEIGHT)) ** 0.5
    width = int(WIDTH * grown)
    K = track.cameras[0].K
    assert float(K[0, 0]) == pytest.approx(FOCAL * (WIDTH // 2) / width)
    center = (width // 8 * 8 / 2 + 0.5) * (WIDTH // 2) / width
    assert float(K[0, 2]) == pytest.approx(center, abs=1e-4)
    places = [float(c.center[0]) for c in track.cameras]
    assert places == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], abs=1e-6)
    assert not track.metric and not track.static and len(track.points) > 1000
    assert track.points[:, 2].numpy() == pytest.approx(WALL, rel=1e-3)
    assert track.colors.max() < 0.3


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (arrays(3), " 3 frames.* 10"),
        ({"cam_c2w": np.tile(np.eye(4), (3, 1, 1))}, "cam_c2w"),
        ({"cam_c2w": np.full((FRAMES, 4, 4), np.nan)}, "cam_c2w"),
        ({"depths": np.zeros_like(arrays()["depths"])}, "depth"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, video, changes, named):
    np.savez(tmp_path / "m.npz", **{**arrays(), **changes})
    with pytest.raises(SourceError, match=named):
        megasam_cameras(video, tmp_path / "m.npz")


def test_a_source_recognises_it_by_its_arrays(tmp_path, video):
    given = {"masks", "landmarks"}
    (tmp_path / "broken.npz").write_bytes(b"PK")
    np.savez(tmp_path / "any name.npz", **arrays(1))
    assert find_source(tmp_path, given=given).cameras == tmp_path / "any name.npz"
    np.savez(tmp_path / "another.npz", **arrays(1))
    with pytest.raises(SourceError, match=r"another.npz, any name.npz"):
        find_source(tmp_path, given=given)
    np.savez(tmp_path / "cameras.npz", K=np.eye(3))
    assert find_source(tmp_path, given=given).cameras == tmp_path / "cameras.npz"
