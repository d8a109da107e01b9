"""Run by the Python of an environment with mediapipe; it imports nothing of hoigs.

Reads RGB frames from standard input, writes image_xyzv and world_xyzv [N, 33, 4] to an .npz file;
NaN where no person is found.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np


def main() -> None:
    try:
        import mediapipe
    except ImportError as error:
        sys.exit(f"this Python has no mediapipe: {error}")
    settings = json.loads(sys.argv[1])
    width, height, count = settings["width"], settings["height"], settings["count"]
    image = np.full((count, 33, 4), np.nan, np.float32)
    world = np.full((count, 33, 4), np.nan, np.float32)
    size = np.array([width, height, width, 1.0])  # z is in the scale of x
    with mediapipe.solutions.pose.Pose(**settings["pose"]) as pose:
        for i in range(count):
            pixels = sys.stdin.buffer.read(height * width * 3)
            if len(pixels) != height * width * 3:
                sys.exit(f"frame {i} of {count} did not come")
            found = pose.process(np.frombuffer(pixels, np.uint8).reshape(height, width, 3))
            if found.pose_landmarks is not None:
                image[i] = points_of(found.pose_landmarks) * size
                world[i] = points_of(found.pose_world_landmarks)
    with Path(settings["out"]).open("wb") as out:
        np.savez(out, image_xyzv=image, world_xyzv=world)


def points_of(found) -> np.ndarray:
    return np.array([[p.x, p.y, p.z, p.visibility] for p in found.landmark])


if __name__ == "__main__":
    main()
