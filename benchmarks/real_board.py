"""The board that a real man turns in his hands, from one camera and one click: place and turn.

    python benchmarks/real_board.py --json benchmarks/results/real-board.json

Needs the recording that does not ship with the package (`HOIGS_SHARED`). Each camera of `fourviews`
is prepared by itself, with its lens and a click on the board in frame 88, and compared with the
board's true pose in 44 frames: `centre_mm` and `shoulders_mm` are the mean distances of its middle
from the truth, in the camera's space and about the middle of the shoulders (of frames in which they
are known); `wander_mm` is what is left without the constant part, such as the middle of another
part of the board; `turn_deg` is the mean of the rotation's error after one constant turn, as the
clip's axes of the object are its own. `seen` counts those of these frames that the clip calls seen.
`said_mm` and `said_deg` are what the clip's report says, and `within` the share of the frames in
which the centre is as near as that. Clips that are in the `--keep` folder are used again.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import clicks
import numpy as np
from real import parser_of, table, true_view


def main() -> int:
    args = parser_of(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.keep or Path(temporary)).absolute()
        rows = {camera: measured(args.data, camera, folder) for camera in args.cameras}
    print(table(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


def measured(data: Path, camera: str, folder: Path) -> dict[str, Any]:
    import hoigs

    out = folder / camera
    if not out.is_dir():
        case = clicks.CASES[f"board-{camera}"]
        (u, v), frame = clicks.board_truth(case)[1][case.click[0]], case.first + case.click[0]
        hoigs.prepare(
            data / f"{camera}.mp4", out, object=f"board={u:.0f},{v:.0f}@{frame}", yes=True,
            calibration=data / f"{camera}.yml",
        )  # fmt: skip
    clip, body, truth = hoigs.read_clip(out), hoigs.AnnyBody(), np.load(data / "truth.npz")
    view, report = true_view(data, camera), json.loads((out / "report.json").read_text())
    there, track = truth["board_valid"], clip.objects["board"]
    seen = np.zeros(len(there), bool)
    seen[report["objects_seen"]["board"]["states"].get("seen", [])] = True
    views = np.stack([c.world_to_camera.double().numpy() for c in clip.cameras])
    centre = np.einsum("fij,fj->fi", views[:, :3, :3], np.asarray(track.translations, float))
    centre = (centre + views[:, :3, 3])[there] * 1000
    true = ((truth["board_center"] @ view[:3, :3].T + view[:3, 3]) * 1000)[there]
    shoulders = np.stack([
        c.to_camera(body(m.poses["human"]).joints)[[16, 17]].mean(0).detach().numpy() * 1000
        for c, m in zip(clip.cameras, clip.moments, strict=True)
    ])[there]  # fmt: skip
    known = truth["joints"][0, :, 11:13] @ view[:3, :3].T + view[:3, 3]
    known[~truth["valid"][0, :, 11:13]] = np.nan
    off, about = centre - true, centre - shoulders - (true - known.mean(1)[there] * 1000)
    said = report["objects_seen"]["board"]
    length = np.linalg.norm(off, axis=-1)
    return {
        "centre_mm": round(float(length.mean())),
        "shoulders_mm": round(float(np.nanmean(np.linalg.norm(about, axis=-1)))),
        "wander_mm": round(float(np.linalg.norm(off - off.mean(0), axis=-1).mean()), 1),
        "turn_deg": round(turn(np.asarray(track.rotations, float), truth, views, view), 1),
        "seen": f"{(seen & there).sum()}/{there.sum()}",
        "said_mm": round(said["place_m"] * 1000),
        "said_deg": round(said["turn_degrees"], 1),
        "within": round(float((length <= said["place_m"] * 1000).mean()), 2),
    }


def turn(found: np.ndarray, truth: Any, views: np.ndarray, view: np.ndarray) -> float:
    """Mean angle in degrees between rotations found and true, after one constant turn."""
    there = truth["board_valid"]
    found = (views[:, :3, :3] @ found)[there]
    true = view[:3, :3] @ truth["board_rotation"][there].astype(float)
    u, _, vt = np.linalg.svd(np.einsum("fji,fjk->ik", found, true))
    constant = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    cosines = (np.einsum("fij,jk,fik->f", found, constant, true) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())


if __name__ == "__main__":
    sys.exit(main())
