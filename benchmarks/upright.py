"""Up by the vertical lines of the room, against the truth of the recorded clip `fourviews`.

    python benchmarks/upright.py --json benchmarks/results/upright.json

For each camera, three frames: degrees between up as `hoigs.preparation.upright.room_up` finds it
and the true one, and the interval that it states; once with the true lens, and once with the focal
length that is assumed without one, whose tilt is off with it. Nothing is masked, which is harder
than in `hoigs prepare`, where the person is. `level` is how far a camera is tilted: the error of a
guess that takes it to be level.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from pathlib import Path

import numpy as np
import torch

from hoigs.core.values.camera import Camera
from hoigs.preparation.cameras.calibration import read_calibration
from hoigs.preparation.cameras.camera_track import ASSUMED_FOCAL
from hoigs.preparation.cameras.focal import USUAL
from hoigs.preparation.upright import _by_focal, _degrees, room_up
from hoigs.preparation.video.frames import open_frames

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).resolve().parents[2] / "shared"))
CAMERAS, FRAMES = ("cam01", "cam02", "cam03", "cam04"), (10, 50, 90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the results to this file")
    args = parser.parse_args()
    found = {name: measure(SHARED / "data" / "fourviews", name) for name in CAMERAS}
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


def measure(folder: Path, name: str) -> dict[str, object]:
    """One camera's figures: degrees off and the stated interval, of each frame."""
    given = json.loads((folder / "cameras.json").read_text())
    given = given.get("cameras", given)[name]
    true = np.array(given["world_to_camera"])[:3, :3] @ (0, 0, 1)
    video = open_frames(folder / f"{name}.mp4")
    size = (video.width, video.height)
    lens, _ = read_calibration(str(folder / f"{name}.yml"), size)
    assumed = lens.K.float().clone()
    assumed[0, 0] = assumed[1, 1] = ASSUMED_FOCAL * max(size)
    usual = (USUAL[0] / ASSUMED_FOCAL, USUAL[1] / ASSUMED_FOCAL)
    undistort, nothing = lens.undistortion(size), np.zeros(size[::-1], bool)
    rows: dict[str, object] = {"level": round(_degrees(true, (0, -1, 0)), 1)}
    for how, K, focal_range in (("lens", lens.K.float(), None), ("assumed", assumed, usual)):
        camera, of_frames = Camera(K, torch.eye(4), *size), []
        for image in video.subset(FRAMES):
            seen = room_up(undistort.image(image) if how == "lens" else image, nothing, camera)
            if seen is None:
                of_frames.append("not clear")
                continue
            within = math.hypot(seen.within, _by_focal(seen.up, focal_range))
            of_frames.append({"off": round(_degrees(seen.up, true), 1), "within": round(within, 1)})
        rows[how] = of_frames
    return rows


if __name__ == "__main__":
    main()
