"""What `hoigs prepare` makes of a built-in clip, against the truth: body, object, and training.

    python benchmarks/estimated.py builtin:lift-and-swing --width 160 --frames 24
    python benchmarks/estimated.py --jobs 5 --train 800 --json benchmarks/results/estimated.json
    python benchmarks/estimated.py --table benchmarks/results/estimated.json
    python benchmarks/estimated.py --variant outline:object_track=outline --variant now:

Each clip is written as a user with good 2D tools has it: frames, true masks, cameras in metres,
2D and 3D landmarks with white noise, nothing else. It is prepared, and the clip that comes out is
compared with the truth. `--train` also trains on it and scores test frames and held-out cameras,
beside the same training on the clip with every pose given. A variant names settings of `prepare`.

Noise: `--noise PX,CM` is the standard deviation of landmarks in the image, pixels of an image 512
wide, and in space; several give several rows. `--camera sfm` keeps the true cameras back.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from estimates.figures import body_figures, camera_motion, object_figures
from estimates.source import write_source
from estimates.training import Training, trained

CLIPS = ("lift-and-swing", "carry", "throw-and-catch", "figure-eight", "jolted-push")


@dataclass(frozen=True)
class Job:
    """One clip, prepared once. seed: of the noise of landmarks, and of training."""

    clip: str
    noise: tuple[float, float]
    variant: str
    settings: tuple[str, ...]
    camera: str
    seed: int
    train: int
    train_width: int
    device: str
    keep: Path | None
    pictures: Path | None
    threads: int
    given: bool
    given_runs: Path | None
    refine: bool


def main() -> int:
    options = _arguments()
    if options.table:
        print(table(json.loads(options.table.read_text())["rows"]))
        return 0
    jobs = list(_jobs(options))
    rows: list[dict[str, Any]] = []
    if options.jobs > 1:
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            place = {pool.submit(measure, job): i for i, job in enumerate(jobs)}
            order: list[int] = []
            for done in as_completed(place):  # written as they end: a run cut short leaves these
                order.append(place[done])
                order.sort()
                _add(rows, done.result(), options, order.index(place[done]))
    else:
        for job in jobs:
            _add(rows, measure(job), options, len(rows))
    return int(any("error" in row for row in rows))


def measure(job: Job) -> dict[str, Any]:
    """A row of figures; "error" in place of them where the clip could not be prepared."""
    import torch

    if job.threads:
        torch.set_num_threads(job.threads)
    folder = job.keep or Path(tempfile.mkdtemp(prefix="estimated-"))
    row: dict[str, Any] = {
        "clip": job.clip, "noise_px": job.noise[0], "noise_cm": job.noise[1],
        "variant": job.variant, "settings": list(job.settings), "camera": job.camera,
        "seed": job.seed,
    }  # fmt: skip
    try:
        return row | _measure(job, folder)
    except Exception as error:  # the other clips are measured all the same
        return row | {"error": f"{type(error).__name__}: {error}"}
    finally:
        if job.keep is None:
            shutil.rmtree(folder, ignore_errors=True)


def _measure(job: Job, folder: Path) -> dict[str, Any]:
    import hoigs
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis.named import named_clip

    body = AnnyBody()
    truth_folder = named_clip(job.clip, body)
    truth = ClipFolderReader().read(truth_folder)
    name = "-".join((job.clip.split(":")[1].split("?")[0], job.variant, f"seed{job.seed}"))
    source, out = folder / f"{name}.source", folder / name
    shutil.rmtree(source, ignore_errors=True)
    write_source(truth, body, source, job.noise, job.seed, cameras=job.camera == "given")
    start = time.perf_counter()
    report = hoigs.prepare(
        source, out, camera="sfm" if job.camera == "sfm" else None, overwrite=True,
        overrides=["image_format=png", "overlay_width=0", f"folder_fps={truth.fps}", *job.settings],
    )  # fmt: skip
    seconds = time.perf_counter() - start
    refined = _refined(out, folder / f"{name}.refined", job) if job.refine else None
    made = ClipFolderReader().read(out)
    row: dict[str, Any] = {
        "frames": len(made), "width": made.cameras[0].width,
        "prepare_s": round(seconds, 1), "stages_s": report.seconds, "warnings": report.warnings,
        "object_provenance": report.provenance["object"],
    }  # fmt: skip
    if len(made) != len(truth):
        return row | {"figures": f"not computed: {len(made)} of {len(truth)} frames have a camera"}
    world = camera_motion(made, truth) if job.camera == "sfm" else (np.eye(3), np.zeros(3))
    row |= object_figures(made, truth, truth_folder, world)
    row |= body_figures(made, truth, body, world)
    if refined is not None:
        after = body_figures(ClipFolderReader().read(refined[0]), truth, body, world)
        row["refined"] = after | {"refine_s": refined[1]}
    if job.train:
        if job.camera == "given":  # otherwise the held-out cameras are of another world
            shutil.copytree(truth_folder / "held_out", out / "held_out", dirs_exist_ok=True)
        how = Training(job.train, job.train_width, job.device, job.seed, job.pictures)
        row["estimated"] = trained(out, folder / f"{name}.run", how)
        if refined is not None:
            if (out / "held_out").is_dir():
                shutil.copytree(out / "held_out", refined[0] / "held_out", dirs_exist_ok=True)
            row["refined"] |= trained(refined[0], folder / f"{name}.refined-run", how)
        if job.given:
            row["every_pose_given"] = _earlier(job) or trained(
                truth_folder, folder / f"{name}.given-run", how
            )
    return row


def _refined(clip: Path, out: Path, job: Job) -> tuple[Path, float]:
    """A clip whose body poses are refined, and how long that took, seconds."""
    import hoigs

    start = time.perf_counter()
    settings = [f"train.seed={job.seed}"]
    hoigs.refine_poses(clip, out, overrides=settings, device=job.device, overwrite=True)
    return out, round(time.perf_counter() - start, 1)


def _earlier(job: Job) -> dict[str, Any] | None:
    """The training with every pose given of an earlier file, of the same clip, seed and length."""
    if job.given_runs is None:
        return None
    record = json.loads(job.given_runs.read_text())
    settings = record["settings"]
    same = (job.train, job.train_width) == (settings["train"], settings["train_width"])
    for row in record["rows"]:
        if same and (row["clip"], row["seed"]) == (job.clip, job.seed):
            return {**row["every_pose_given"], "taken_from": job.given_runs.name}
    return None


# ---- the command


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", nargs="*", default=[f"builtin:{name}" for name in CLIPS])
    parser.add_argument("--width", type=int, default=256, help="of the clip's square frames")
    parser.add_argument("--frames", type=int, help="of each clip; default: its own")
    parser.add_argument("--noise", nargs="+", default=["2,2"], metavar="PX,CM")
    parser.add_argument("--camera", nargs="+", default=["given"], choices=("given", "sfm"))
    parser.add_argument(
        "--variant", action="append", metavar="NAME:KEY=VALUE,...",
        help="settings of `hoigs prepare` under a name; several give several rows",
    )  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--train", type=int, default=0, metavar="STEPS")
    parser.add_argument("--train-width", type=int, help="default: --width")
    parser.add_argument("--refine", action="store_true", help="also with `hoigs refine`")
    parser.add_argument("--no-given", action="store_true", help="train on estimated poses only")
    parser.add_argument(
        "--given-runs", type=Path, metavar="JSON",
        help="an earlier --json, whose trainings with every pose given are taken over where clip, "
        "seed, steps and width are the same: `prepare` has no part in them",
    )  # fmt: skip
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--keep", type=Path, help="folder that sources, clips and runs stay in")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of trained runs")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--table", type=Path, help="print the rows of such a file, run nothing")
    return parser.parse_args()


def _jobs(options: argparse.Namespace) -> Iterator[Job]:
    threads = max(1, (os.cpu_count() or 1) // options.jobs) if options.jobs > 1 else 0
    variants = [text.partition(":") for text in options.variant or ["default:"]]
    levels = [tuple(float(v) for v in text.split(",")) for text in options.noise]
    for clip, noise, variant, camera, seed in product(
        options.clips, levels, variants, options.camera, options.seeds
    ):
        extra = f"width={options.width}"
        extra += f"&frames={options.frames}" if options.frames else ""
        clip = f"builtin:{clip.removeprefix('builtin:')}"
        yield Job(
            clip=f"{clip}{'&' if '?' in clip else '?'}{extra}", noise=noise, variant=variant[0],
            settings=tuple(filter(None, variant[2].split(","))), camera=camera, seed=seed,
            train=options.train, train_width=options.train_width or options.width,
            device=options.device, keep=options.keep, pictures=options.pictures, threads=threads,
            given=not options.no_given, given_runs=options.given_runs,
            refine=options.refine,
        )  # fmt: skip


def _add(
    rows: list[dict[str, Any]], row: dict[str, Any], options: argparse.Namespace, place: int
) -> None:
    """Insert a row at its place, print it and write all."""
    rows.insert(place, row)
    print(_line(row), flush=True)
    if options.json:
        given = {k: str(v) if isinstance(v, Path) else v for k, v in vars(options).items()}
        record = {"settings": given, "rows": rows}
        temporary = options.json.with_name(f".{options.json.name}.{os.getpid()}.part")
        temporary.write_text(json.dumps(record, indent=1) + "\n")
        temporary.replace(options.json)


FIGURES = ("joints mm", "wrists mm", "acceleration m/s²", "rotation °", "place mm", "Chamfer mm")


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: what was estimated, and PSNR of person + object beside the run with all poses; of
    rows without trainings, the noise of the landmarks and the source of the cameras."""
    trained = [row for row in rows if "estimated" in row]
    if not trained:
        first = ("clip", "seed", "noise", "camera", *FIGURES)
        lines = [
            [*_first(row), f"{row['noise_px']:g} px, {row['noise_cm']:g} cm", row["camera"],
             *_figures(row)]
            for row in rows if "rotation_deg" in row
        ]  # fmt: skip
        return _markdown(first, lines)
    if any("refined" in row for row in trained):
        return _refined_table(trained)
    head = (
        "clip", "seed", *FIGURES, "path", "path, all given", "held out", "held out, all given",
        "object held out", "object held out, all given",
    )  # fmt: skip
    lines = []
    for row in trained:
        found: list[Any] = [*_first(row), *_figures(row)]
        given = row.get("every_pose_given")
        runs = (row["estimated"]["blended poses"], given and given["given poses"])
        for view, region in (
            ("test frames", "human_object"), ("held-out cameras", "human_object"),
            ("held-out cameras", "object"),
        ):  # fmt: skip
            found += [run[view][region] if run else "-" for run in runs]
        lines.append(found)
    return _markdown(head, lines)


def _refined_table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: bodies and PSNR of person + object as estimated, and refined."""
    figures = ("joints mm", "wrists mm", "acceleration m/s²", "path", "interpolated", "held out")
    head = ("clip", "seed", *(f"{name}, {how}" for name in figures for how in ("est.", "refined")))
    views = (
        ("blended poses", "test frames"), ("interpolated poses", "test frames"),
        ("blended poses", "held-out cameras"),
    )  # fmt: skip
    lines = []
    for row in rows:
        both = (row, row["refined"])
        found: list[Any] = _first(row)
        for key in ("root_aligned_joints_mm", "wrists_mm", "acceleration_error_m_s2"):
            found += [one[key] for one in both]
        for poses, view in views:
            found += [
                run[poses][view]["human_object"] for run in (row["estimated"], row["refined"])
            ]
        lines.append(found)
    return _markdown(head, lines)


def _markdown(head: Sequence[str], lines: Sequence[Sequence[Any]]) -> str:
    every = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in every)


def _first(row: dict[str, Any]) -> list[Any]:
    return [row["clip"].removeprefix("builtin:").split("?")[0], row["seed"]]


def _figures(row: dict[str, Any]) -> list[Any]:
    return [
        row["root_aligned_joints_mm"], row["wrists_mm"], row["acceleration_error_m_s2"],
        row["rotation_deg"]["median"], row["place_mm"]["mean"], row["chamfer_mm"],
    ]  # fmt: skip


def _line(row: dict[str, Any]) -> str:
    head = (
        f"{row['clip']} {row['variant']} noise {row['noise_px']:g} px {row['noise_cm']:g} cm "
        f"{row['camera']} seed {row['seed']}: "
    )
    if "rotation_deg" not in row:
        return head + str(row.get("error", row.get("figures")))
    turn, place = row["rotation_deg"], row["place_mm"]
    lines = [
        f"rotation {turn['median']} deg (p95 {turn['p95']}; none at all "
        f"{row['rotation_none_at_all_deg']}; best frame "
        f"{row['rotation_best_frame_deg']['median']})",
        f"place {place['mean']} mm ({row['place_along_view_mm']} along, "
        f"{row['place_across_view_mm']} across the view)",
        f"chamfer {row['chamfer_mm']} mm, size x{row['size_ratio']}",
        f"joints {row['root_aligned_joints_mm']} mm, wrists {row['wrists_mm']} mm, "
        f"acceleration {row['acceleration_error_m_s2']} m/s2",
        f"{row['prepare_s']} s",
    ]
    further = ("estimated", "refined", "every_pose_given")
    lines += [f"{name}: {row[name]}" for name in further if name in row]
    return head + "\n  ".join(["", *lines])


if __name__ == "__main__":
    sys.exit(main())
