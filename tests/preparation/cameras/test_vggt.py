"""VGGT's predictions.npz beside a video: cameras, and points of what stands still."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.preparation.cameras.known import vggt_cameras
from hoigs.preparation.video.source import SourceError, find_source
from tests.preparation.tiny import FRAMES, HEIGHT, WIDTH

FOCAL, WALL = 500.0, 4.0
TALL = round(HEIGHT * 518 / WIDTH / 14) * 14


def arrays(frames: int = FRAMES, *, bordered: bool = False) -> dict[str, np.ndarray]:
    """A camera goes right along a wall."""
    height = 518 if bordered else TALL
    images = np.full((frames, 3, height, 518), 0.2, np.float32)
    if bordered:
        top = (518 - TALL) // 2
        images[:, :, :top], images[:, :, top + TALL :] = 1.0, 1.0
    K = np.array([[FOCAL, 0, 259], [0, FOCAL, height / 2], [0, 0, 1]], np.float32)
    views = np.tile(np.eye(4, dtype=np.float32)[:3], (frames, 1, 1))
    views[:, 0, 3] = -0.05 * np.arange(frames)
    depth = np.full((frames, height, 518, 1), WALL, np.float32)
    return {
        "pose_enc": np.zeros((frames, 9), np.float32), "depth": depth, "depth_conf": depth[..., 0],
        "images": images, "extrinsic": views, "intrinsic": np.tile(K, (frames, 1, 1)),
    }  # fmt: skip


@pytest.mark.parametrize("bordered", [False, True])
def test_cameras_at_the_chosen_width(tmp_path, video, bordered):
    path = tmp_path / "predictions.npz"
    np.savez(path, **arrays(bordered=bordered))
    assert find_source(tmp_path, given={"masks", "landmarks"}, complete=True).cameras == path
    track = vggt_cameras(video, path)
    K = track.cameras[0].K
    assert float(K[0, 0]) == pytest.approx(FOCAL * (WIDTH // 2) / 518)
    assert float(K[0, 2]) == pytest.approx(WIDTH / 4)
    assert float(K[1, 2]) == pytest.approx(HEIGHT / 4, abs=0.05)
    places = [float(c.center[0]) for c in track.cameras]
    assert places == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], abs=1e-6)
    assert not track.metric and track.points[:, 2].numpy() == pytest.approx(WALL, rel=1e-3)


def test_what_does_not_fit_is_named(tmp_path, video):
    path = tmp_path / "p.npz"
    good = arrays()
    for changes, named in (
        (arrays(3), " 3 frames"),
        ({"extrinsic": good["extrinsic"][:, :2]}, "extrinsic"),
        ({"intrinsic": np.full((FRAMES, 3, 3), np.nan)}, "intrinsic"),
        ({"images": good["images"][..., :504], "depth": good["depth"][:, :, :504]}, "504x"),
    ):
        np.savez(path, **{**good, **changes})
        with pytest.raises(SourceError, match=named):
            vggt_cameras(video, path)
