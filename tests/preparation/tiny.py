"""The tiny scene of conftest.py, as functions of the frame number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

FRAMES, WIDTH, HEIGHT = 12, 96, 64
_Y, _X = np.mgrid[:HEIGHT, :WIDTH] + 0.5


def BALL(frame: int) -> tuple[float, float, float]:
    """Centre x, y and radius, pixels."""
    return 20.0 + 3.5 * frame, 36.0 - 0.8 * frame, 9.0 - 0.15 * frame


def masks(frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The person and the ball in front of it, bool [H, W]."""
    x, y, r = BALL(frame)
    ball = (_X - x) ** 2 + (_Y - y) ** 2 <= r * r
    human = (np.abs(_X - 48) < 8) & (np.abs(_Y - 34) < 26)
    return human & ~ball, ball


def background() -> np.ndarray:
    """RGB of the scene alone: a smooth ramp, so that compression keeps it."""
    ramp = np.stack((_X / WIDTH * 120, _Y / HEIGHT * 90 + 40, 0 * _X + 60), -1)
    return ramp.astype(np.uint8)


def picture(frame: int) -> np.ndarray:
    image = background()
    human, ball = masks(frame)
    image[human] = (90, 30, 110)
    image[ball] = (235, 235, 225)
    return image


# MediaPipe's 33 landmarks of a standing person, hip-centred, metres, y down
_BODY = np.zeros((33, 3))
for _i, _xyz in {
    0: (0, -0.62, -0.1), 7: (0.07, -0.64, 0), 8: (-0.07, -0.64, 0), 9: (0.02, -0.57, -0.1),
    10: (-0.02, -0.57, -0.1), 11: (0.17, -0.48, 0), 12: (-0.17, -0.48, 0), 13: (0.22, -0.22, 0),
    14: (-0.22, -0.22, 0), 15: (0.24, 0.02, 0), 16: (-0.24, 0.02, 0), 17: (0.25, 0.1, 0),
    18: (-0.25, 0.1, 0), 19: (0.24, 0.11, 0), 20: (-0.24, 0.11, 0), 21: (0.22, 0.07, 0),
    22: (-0.22, 0.07, 0), 23: (0.1, 0, 0), 24: (-0.1, 0, 0), 25: (0.11, 0.42, 0),
    26: (-0.11, 0.42, 0), 27: (0.11, 0.82, 0.05), 28: (-0.11, 0.82, 0.05), 29: (0.11, 0.88, 0.08),
    30: (-0.11, 0.88, 0.08), 31: (0.12, 0.88, -0.12), 32: (-0.12, 0.88, -0.12),
}.items():  # fmt: skip
    _BODY[_i] = _xyz
for _i in (1, 2, 3):
    _BODY[_i] = (0.03, -0.65, -0.09)
for _i in (4, 5, 6):
    _BODY[_i] = (-0.03, -0.65, -0.09)


def landmarks(focal: float = 0.8 * WIDTH, step: float = 0.0) -> dict[str, np.ndarray]:
    """pose_mediapipe.npz of that person standing still 2.8 m away.

    Args:
        focal: pixels. step: how far the camera walks to the right in each frame, metres.
    """
    image = np.zeros((FRAMES, 33, 4))
    for frame in range(FRAMES):
        seen = _BODY + np.array((-step * frame, 0, 2.8))
        image[frame, :, :2] = seen[:, :2] / seen[:, 2:] * focal + (WIDTH / 2, 32)
    image[..., 2], image[..., 3] = _BODY[:, 2] * 30, 0.99
    world = np.concatenate((_BODY, np.full((33, 1), 0.99)), -1)
    return {
        "image_xyzv": image.astype(np.float32),
        "world_xyzv": np.repeat(world[None], FRAMES, 0).astype(np.float32),
    }


def make_source(folder: Path, video: Path) -> Path:
    """A source folder: video, masks together, ball track, landmarks; no COLMAP."""
    (folder / "hoi_mask").mkdir(parents=True)
    (folder / "video.mp4").write_bytes(video.read_bytes())
    for i in range(FRAMES):
        Image.fromarray(np.logical_or(*masks(i))).save(folder / f"hoi_mask/{i:05d}.png")
    track = np.array([BALL(i) for i in range(FRAMES)], np.float32)
    track[5] = np.nan  # not found there
    np.savez(folder / "ball_track.npz", xyr=track)
    np.savez(folder / "pose_mediapipe.npz", **landmarks())
    return folder
