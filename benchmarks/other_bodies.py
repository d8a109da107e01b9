"""`hoigs prepare` from another program's body, and masks and cameras, against the truth.

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
import torch
from estimates.bodies import write_bodies
from estimates.figures import body_figures
from estimates.source import write_source

CLIP = "builtin:lift-and-swing?width=128&frames=24"
# noise of landmarks: px, cm; of files: degrees, cm
CASES = (
    ("landmarks", (2.0, 2.0)), ("gvhmr", (0.0, 0.0)), ("gvhmr", (2.0, 1.0)),
    ("wham", (0.0, 0.0)), ("wham", (2.0, 1.0)), ("sam-3d-body", (0.0, 0.0)),
    ("sam-3d-body", (0.0, 3.0)),
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
    head = "from", "noise", "the file, about pelvis", "about pelvis", "joints", "wrists"
    print(f"| {' | '.join(head)} |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        values = [row[key] for key in ("from", "noise")]
        values += [row[k] for k in ("file_mm", "root_aligned_joints_mm", "joints_mm", "wrists_mm")]
        print(f"| {' | '.join(map(str, values))} |")
    return 0


def measure(what: str, noise: tuple[float, float]) -> dict[str, Any]:
    """Errors of the body that is prepared from one file."""
    import hoigs
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis.named import named_clip

    body, folder = AnnyBody(), Path(tempfile.mkdtemp(prefix="other-bodies-"))
    try:
        truth = ClipFolderReader().read(named_clip(CLIP, body))
        source = folder / "source"
        own: dict[str, Any] = {"file_mm": "-"}
        write_source(truth, body, source, noise, 0, cameras=True)
        if what != "landmarks":
            (source / "pose_mediapipe.npz").unlink()
            path = write_bodies(truth, body, what, source, *noise)
            if what != "sam-3d-body":  # which has no joint rotations
                own = {"file_mm": file_error(path, truth, body)}
        hoigs.prepare(
            source, folder / "clip", body=body, object="none",
            overrides=["image_format=png", "overlay_width=0", f"folder_fps={truth.fps}"],
        )  # fmt: skip
        made = ClipFolderReader().read(folder / "clip")
        still = np.eye(3), np.zeros(3)
        unit = "px" if what == "landmarks" else "degrees"
        return {
            "from": what, "noise": f"{noise[0]:g} {unit}, {noise[1]:g} cm",
            **own,
            **body_figures(made, truth, body, still),
        }  # fmt: skip
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def file_error(path: Path, truth: Any, body: Any) -> float:
    """Joints about the pelvis in the file itself, mm off: no fit and no camera is in it."""
    from hoigs.core.values.moment import BodyPose
    from hoigs.preparation.body.body_files import read_bodies

    turns = torch.from_numpy(read_bodies(path).turns).float()
    theirs = BodyPose.zeros(len(turns), betas=body.num_betas).replace(
        global_orient=turns[:, 0], body=turns[:, 1:]
    )
    poses = truth.bodies["human"].poses
    found, true = (body(pose).joints[:, :22] for pose in (theirs, poses))
    found = found @ torch.stack([c.world_to_camera[:3, :3] for c in truth.cameras])
    off = (found - found[:, :1]) - (true - true[:, :1])
    return round(float(1000 * off.norm(dim=-1).mean()), 1)


if __name__ == "__main__":
    sys.exit(main())
