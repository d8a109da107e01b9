"""The body of real recordings with truth, from one camera each: what it is off from other sides.

    python benchmarks/real.py --json benchmarks/results/real.json

Needs the recordings that do not ship with the package (`HOIGS_SHARED`). Each camera of `fourviews`
is prepared by itself, with its lens, and scored by the recording's own `score.py`; lengths are
millimetres, sizes are the clip's in parts of the truth. `within` is the share of the frames in
which the body is as near to the truth as the clip's report says.

`up_off` and `up_said` are the degrees by which the clip's up is off, and those within which it says
it is. `guessed_of_far` counts the wrists more than 150 mm off about the shoulders of which the
report says that their arm is a guess, of all such, and `guessed_of_near` the others. `px_camNN` is
the median distance of the body's joints from the true ones as camera NN sees them; `iou_camNN` how
well the body's outline there agrees with the mask that the clip of that camera itself has of the
man (looked at: right but for a fringe of hair and the gap below an arm), in frames without the
board, mean. The row's own camera tells what a perfect pose could reach.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from estimates.figures import within_figures

SHARED = Path(os.environ.get("HOIGS_SHARED", Path(__file__).resolve().parents[2] / "shared"))
CAMERAS = ("cam02", "cam03", "cam04")  # cam01 sees no elbows


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--pictures", type=Path, help="folder for the body in others' frames")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.keep or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        rows = {camera: measured(args.data, camera, folder) for camera in args.cameras}
        for camera, row in rows.items():
            row |= {
                f"iou_{other}": from_side(args.data, folder, camera, other, args.pictures)
                for other in rows
            }
    print(table(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


def parser_of(text: str) -> argparse.ArgumentParser:
    """Options of what is measured on the recording, described by the first line of a text."""
    parser = argparse.ArgumentParser(description=text.splitlines()[0])
    parser.add_argument("--data", type=recording, default=str(SHARED / "data/fourviews"))
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=CAMERAS)
    parser.add_argument("--keep", type=Path, help="folder in which clips and their work stay")
    parser.add_argument("--json", type=Path)
    return parser


def recording(text: str) -> Path:
    """Its folder, which has to be there."""
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(
            f"there is no {text}: set HOIGS_SHARED to the folder that holds data/"
        )
    return Path(text)


def measured(data: Path, camera: str, folder: Path) -> dict[str, Any]:
    """What `score.py` makes of the clip of one camera."""
    import hoigs

    out, scores = folder / camera, folder / f"{camera}.json"
    hoigs.prepare(
        data / f"{camera}.mp4", out, object="none", calibration=data / f"{camera}.yml", yes=True,
        overwrite=True,
    )  # fmt: skip
    argv = [sys.executable, str(data / "score.py"), str(out), "--camera", camera]
    subprocess.run([*argv, "--json", str(scores)], check=True, stdout=subprocess.DEVNULL)
    found = json.loads(scores.read_text())
    row = {
        "root_aligned": found["root_aligned"],
        "procrustes": found["procrustes"],
        "size": 1 / found["procrustes_scale"],
        "neck_depth": 1 + found["neck_depth_bias"] / found["neck_depth_true"],
        "acceleration_error": found["acceleration_error"],
    }
    pixels = found["other_views_px_median"] | {camera: found["image_px_median"]}
    row |= {f"px_{other}": pixels[other] for other in sorted(pixels)}
    return {name: round(value, 3) for name, value in row.items()} | within(data, camera, out)


MARKS = {11: 16, 12: 17, 13: 18, 14: 19, 15: 20, 16: 21}  # landmark of the truth -> body joint


def true_view(data: Path, camera: str) -> np.ndarray:
    """world_to_camera, metres."""
    cameras = json.loads((data / "cameras.json").read_text())["cameras"]
    return np.array(cameras[camera]["world_to_camera"])


def within(data: Path, camera: str, out: Path) -> dict[str, Any]:
    """Whether what the clip says of the body and of up holds."""
    import hoigs

    clip, body, truth = hoigs.read_clip(out), hoigs.AnnyBody(), np.load(data / "truth.npz")
    view, header = true_view(data, camera), json.loads((out / "clip.json").read_text())
    frames = header["provenance"]["frames"]
    true = truth["joints"][0, frames][:, list(MARKS)] @ view[:3, :3].T + view[:3, 3]
    true[~truth["valid"][0, frames][:, list(MARKS)]] = np.nan
    joints = np.stack([
        c.to_camera(body(moment.poses["human"]).joints)[list(MARKS.values())].detach().numpy()
        for c, moment in zip(clip.cameras, clip.moments, strict=True)
    ])  # fmt: skip
    report = json.loads((out / "report.json").read_text())
    up = clip.cameras[0].world_to_camera[:3, :3].double().numpy() @ header["world"]["up"]
    off = np.degrees(np.arccos(np.clip(up @ view[:3, 2], -1, 1)))
    said = {"up_off": round(float(off), 1), "up_said": header["world"]["within"]}
    human = report["bodies_within"]["human"]
    return within_figures(joints, true, human) | said | guesses(joints, true, human["guessed"])


FAR = 0.15  # metres that a wrist is off


def guesses(joints: np.ndarray, true: np.ndarray, guessed: dict[str, list[int]]) -> dict[str, str]:
    """How many of the wrists that are far off, and of the others, the report takes for guesses."""
    about, true_about = (j - j[:, :2].mean(1, keepdims=True) for j in (joints, true))
    off = np.linalg.norm(about - true_about, axis=-1)[:, -2:]
    said = np.zeros(off.shape, bool)
    for arm, name in enumerate(("left arm", "right arm")):
        said[guessed[name], arm] = True
    parts = {"guessed_of_far": off > FAR, "guessed_of_near": off <= FAR}
    return {name: f"{(said & part).sum()}/{part.sum()}" for name, part in parts.items()}


STEP, SHOWN = 4, 3  # frames from one that is compared to the next; how many become pictures


def from_side(data: Path, folder: Path, camera: str, other: str, pictures: Path | None) -> float:
    """Mean IoU of one camera's body and another one's mask, as that one sees them."""
    from PIL import Image

    import hoigs
    from hoigs.preparation.body.mask_fit import silhouette

    clip, seen, body = (
        hoigs.read_clip(folder / camera), hoigs.read_clip(folder / other), hoigs.AnnyBody(),
    )  # fmt: skip
    onto = torch.from_numpy(true_view(data, other) @ np.linalg.inv(true_view(data, camera)))
    frames = np.flatnonzero(~np.load(data / "truth.npz")["board_valid"])[::STEP].tolist()
    shared, strip = [], []
    for number, frame in enumerate(frames):
        view = onto.float() @ clip.cameras[frame].world_to_camera
        there = replace(seen.cameras[frame], world_to_camera=view)
        vertices = body(clip.moments[frame].poses["human"]).vertices.detach()
        drawn = silhouette(vertices, body.faces, there)
        mask = seen.store.mask("human", frame).numpy()
        shared.append((drawn & mask).sum() / (drawn | mask).sum())
        if number % -(-len(frames) // SHOWN) == 0:
            image = seen.store.image(frame).numpy() // 2
            image[drawn] += np.array([127, 0, 0], np.uint8)
            image[mask] += np.array([0, 127, 0], np.uint8)
            strip.append(image[::2, ::2])
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.concatenate(strip, 1)).save(pictures / f"{camera}-in-{other}.png")
    return round(float(np.mean(shared)), 3)


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Markdown, one line a camera."""
    names = list(next(iter(rows.values())))
    lines = [["camera", *names], ["---"] * (len(names) + 1)]
    lines += [[camera, *(f"{row[name]}" for name in names)] for camera, row in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
