"""Answers as `outlines_script.py` does: what is clicked is all that has its colour in the picture,
and none of those at points that are outside.

The middle of a box stands for a click.
"""

import json
import sys

import numpy as np

SIDE, CELLS = 1024, 256
CLOSE = 60  # of 255, in which channels colours are alike


def main() -> None:
    image = None
    while line := sys.stdin.buffer.readline():
        request = json.loads(line)
        if "image" in request:
            height, width = request["image"]
            pixels = np.frombuffer(sys.stdin.buffer.read(height * width * 3), np.uint8)
            image = pixels.reshape(height, width, 3)[2::4, 2::4].astype(int)
            continue
        points, labels = np.array(request["points"]), np.array(request["labels"])
        x, y = points[labels >= (2 if 2 in labels else 1)].mean(0) / 4
        if not (0 <= y < image.shape[0] and 0 <= x < image.shape[1]):
            sys.exit(f"{x:.0f},{y:.0f} is not in the picture")
        away = np.abs(image - image[int(y), int(x)])
        alike = (away < CLOSE).all(-1)
        for u, v in (points[labels == 0] / 4).astype(int):
            alike &= away.sum(-1) < np.abs(image - image[v, u]).sum(-1)
        odds = np.full((4, CELLS, CELLS), -9, np.float16)
        odds[:, : len(alike), : alike.shape[1]] = np.where(alike, 9, -9)
        sys.stdout.buffer.write(b'{"overlaps": [0.9, 0.9, 0.9, 0.9]}\n' + odds.tobytes())
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
