"""A tiny recorded scene: a person-shaped rectangle and a bright ball that moves, 12 frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny import BALL, FRAMES, HEIGHT, WIDTH, landmarks, masks, picture

from hoigs.preparation.video_out import VideoWriter


@pytest.fixture(scope="session")
def tiny_video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "tiny.mp4"
    with VideoWriter(path, fps=12, crf=8) as video:
        for i in range(FRAMES):
            video.add(picture(i))
    return path


@pytest.fixture
def tiny_source(tiny_video: Path, tmp_path: Path) -> Path:
    """A source folder: video, masks together, ball track, landmarks; no COLMAP."""
    folder = tmp_path / "source"
    (folder / "hoi_mask").mkdir(parents=True)
    (folder / "video.mp4").write_bytes(tiny_video.read_bytes())
    for i in range(FRAMES):
        human, ball = masks(i)
        Image.fromarray((human | ball).astype(np.uint8) * 255).save(
            folder / f"hoi_mask/{i:05d}.png"
        )
    track = np.array([BALL(i) for i in range(FRAMES)], np.float32)
    track[5] = np.nan
    np.savez(folder / "ball_track.npz", xyr=track)
    np.savez(folder / "pose_mediapipe.npz", **landmarks())
    assert picture(0).shape[1::-1] == (WIDTH, HEIGHT)
    return folder
