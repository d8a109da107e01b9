"""`hoigs prepare` from a body file of GVHMR or WHAM and masks, against the truth.

    python benchmarks/other_bodies.py [--json benchmarks/results/other-bodies.json]

A built-in clip's true body is written as each program would have written it, with noise of each
joint's rotation and of the place; beside it the run from noisy landmarks of estimated.py.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from estimates.bodies import write_bodies
from estimates.figures import body_figures
from estimates.source import write_source

CLIP = "builtin:lift-and-swing?width=128&frames=24"
# landmarks: px, cm; files: degrees, cm. The last have no cameras.npz: intrinsics are the file's
CASES = (
    ("landmarks", (2.0, 2.0), True), ("gvhmr", (0.0, 0.0), True), ("gvhmr", (5.0, 2.0), True),
    ("wham", (0.0, 0.0), True), ("wham", (5.0, 2.0), True),
    ("gvhmr", (0.0, 0.0), False), ("gvhmr", (5.0, 2.0), False),
)  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for case in CASES:
        rows.append(measure(*case))
        print(rows[-1], flush=True)
    if options.json:
        options.json.write_text(json.dumps({"clip": CLIP, "rows": rows}, indent=1) + "\n")
    print("| from | noise | cameras | joints mm | about the pelvis mm | wrists mm |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        values = [row[key] for key in ("from", "noise", "cameras")]
        values += [row[k] for k in ("joints_mm", "root_aligned_joints_mm", "wrists_mm")]
        print(f"| {' | '.join(map(str, values))} |")
    return 0


def measure(what: str, noise: tuple[float, float], cameras: bool) -> dict[str, Any]:
    """Errors of the body that is prepared from one file."""
    import hoigs
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis.named import named_clip

    body, folder = AnnyBody(), Path(tempfile.mkdtemp(prefix="other-bodies-"))
    try:
        truth = ClipFolderReader().read(named_clip(CLIP, body))
        source = folder / "source"
        write_source(truth, body, source, noise, 0, cameras=cameras)
        if what != "landmarks":
            (source / "pose_mediapipe.npz").unlink()
            write_bodies(truth, body, what, source, *noise)
        report = hoigs.prepare(
            source, folder / "clip", body=body, camera=None if cameras else "static",
            object="none",
            overrides=["image_format=png", "overlay_width=0", f"folder_fps={truth.fps}"],
        )  # fmt: skip
        made = ClipFolderReader().read(folder / "clip")
        motion = np.eye(3), np.zeros(3)
        if not cameras:  # the made world is the true camera's, which stands still
            view = truth.cameras[0].world_to_camera.double().numpy()
            motion = view[:3, :3].T, -view[:3, :3].T @ view[:3, 3]
        unit = "px" if what == "landmarks" else "degrees"
        return {
            "from": what, "noise": f"{noise[0]:g} {unit}, {noise[1]:g} cm",
            "cameras": "given" if cameras else report.provenance["cameras"],
            **body_figures(made, truth, body, motion),
        }  # fmt: skip
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
