"""cameras.npz beside a video: cameras in metres."""

from __future__ import annotations

import numpy as np
import pytest

from hoigs.preparation.cameras.known import given_cameras
from hoigs.preparation.video.source import SourceError, find_source
from tests.preparation.tiny import FRAMES, HEIGHT, WIDTH


def cameras(**changes: np.ndarray) -> dict[str, np.ndarray]:
    K = np.array([[80.0, 0, WIDTH / 2], [0, 80, HEIGHT / 2], [0, 0, 1]])
    views = np.tile(np.eye(4), (FRAMES, 1, 1))
    views[:, 0, 3] = np.arange(FRAMES)
    found = {"K": np.tile(K, (FRAMES, 1, 1)), "world_to_camera": views, "points": np.ones((5, 3))}
    return {**found, **changes}


def test_rows_are_the_videos_frames_and_pixels_those_of_the_chosen_width(tmp_path, video):
    np.savez(tmp_path / "cameras.npz", **cameras())
    track = given_cameras(video, tmp_path / "cameras.npz")
    assert [float(c.world_to_camera[0, 3]) for c in track.cameras] == [0, 2, 4, 6, 8, 10]
    assert float(track.cameras[0].K[0, 0]) == 40
    assert track.metric and not track.static


def test_a_camera_that_stands_still_needs_no_points(tmp_path, video):
    still = np.tile(np.eye(4), (FRAMES, 1, 1))
    np.savez(tmp_path / "c.npz", **cameras(world_to_camera=still, points=np.zeros((0, 3))))
    assert given_cameras(video, tmp_path / "c.npz").static


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"points": np.zeros((0, 3))}, "points"),
        ({"K": np.ones((3, 3, 3))}, "3 of K"),
        ({"world_to_camera": np.full((FRAMES, 4, 4), np.nan)}, "world_to_camera"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, video, changes, named):
    np.savez(tmp_path / "c.npz", **cameras(**changes))
    with pytest.raises(SourceError, match=named):
        given_cameras(video, tmp_path / "c.npz")


def test_a_source_finds_it_unless_cameras_are_to_be_made(tmp_path, video):
    np.savez(tmp_path / "cameras.npz", **cameras())
    given = {"masks", "landmarks"}
    assert find_source(tmp_path, given=given).cameras == tmp_path / "cameras.npz"
    assert find_source(tmp_path, given=given, own_cameras=True).cameras is None
