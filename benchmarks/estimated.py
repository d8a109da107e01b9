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
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

CLIPS = ("lift-and-swing", "carry", "throw-and-catch", "figure-eight", "jolted-push")
REFERENCE_WIDTH = 512  # of the image whose pixels the noise is given in
REGIONS = ("human_object", "object", "full")


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


def main() -> int:
    options = _arguments()
    if options.table:
        print(table(json.loads(options.table.read_text())["rows"]))
        return 0
    jobs = list(_jobs(options))
    rows: list[dict[str, Any]] = []
    if options.jobs > 1:
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            for row in pool.map(measure, jobs):
                _add(rows, row, options)
    else:
        for job in jobs:
            _add(rows, measure(job), options)
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
    if job.train:
        if job.camera == "given":  # otherwise the held-out cameras are of another world
            shutil.copytree(truth_folder / "held_out", out / "held_out", dirs_exist_ok=True)
        row["estimated"] = trained(out, folder / f"{name}.run", job)
        row["every_pose_given"] = trained(truth_folder, folder / f"{name}.given-run", job)
    return row


# ---- the source folder


def write_source(
    clip: Any, body: Any, folder: Path, noise: tuple[float, float], seed: int, *, cameras: bool
) -> None:
    """Frames, masks and landmarks of a clip as `hoigs prepare` reads them.

    Args:
        noise: of landmarks, in pixels of an image 512 wide, and centimetres.
        cameras: also cameras and scene points, in cameras.npz.
    """
    for name in ("frames", "masks/human", "masks/object"):
        (folder / name).mkdir(parents=True)
    for i, frame in enumerate(clip):
        Image.fromarray(frame.image.numpy()).save(folder / f"frames/{i:05d}.png")
        for name in ("human", "object"):
            path = folder / f"masks/{name}/{i:05d}.png"
            Image.fromarray(frame.masks[name].numpy()).save(path)
    np.savez(folder / "pose_mediapipe.npz", **landmarks(clip, body, noise, seed))
    if cameras:
        np.savez(
            folder / "cameras.npz",
            K=np.stack([c.K.numpy() for c in clip.cameras]),
            world_to_camera=np.stack([c.world_to_camera.numpy() for c in clip.cameras]),
            points=clip.points.numpy(),
            colors=clip.point_colors.numpy(),
        )


def landmarks(clip: Any, body: Any, noise: tuple[float, float], seed: int) -> dict[str, np.ndarray]:
    """pose_mediapipe.npz of the true body: MediaPipe's landmarks that have a place on it."""
    import torch

    from hoigs.core.maths.skinning import skin
    from hoigs.preparation.body.landmarks import points_of

    points, rng = points_of(body), np.random.default_rng(seed)
    poses = clip.bodies["human"].poses
    vertices, joints = body.shaped(poses.betas)
    weights = torch.cat(
        (torch.eye(len(joints))[points.joints], body.skinning_weights[points.vertices])
    )
    canonical = torch.cat((joints[points.joints], vertices[points.vertices]))
    joint_transforms = body.skinning_transforms(poses)
    world = skin(canonical, joint_transforms, weights).numpy()
    marks = list(points.landmarks)
    image = np.full((len(clip), 33, 4), np.nan, np.float32)
    space = np.full((len(clip), 33, 4), np.nan, np.float32)
    hips = [marks.index(23), marks.index(24)]
    for i, camera in enumerate(clip.cameras):
        xy, depth = camera.project(torch.from_numpy(world[i]))
        seen = camera.to_camera(torch.from_numpy(world[i])).numpy()
        xy = xy.numpy() + rng.normal(size=(len(marks), 2)) * noise[0] * (
            camera.width / REFERENCE_WIDTH
        )
        image[i, marks] = np.concatenate((xy, depth[:, None], np.ones((len(marks), 1))), 1)
        seen = seen - seen[hips].mean(0) + rng.normal(size=seen.shape) * noise[1] / 100
        space[i, marks] = np.concatenate((seen, np.ones((len(marks), 1))), 1)
    return {"image_xyzv": image, "world_xyzv": space}


# ---- figures


World = tuple[np.ndarray, np.ndarray]  # rotation and shift from the clip's world to the true one


def object_figures(made: Any, truth: Any, truth_folder: Path, world: World) -> dict[str, Any]:
    """Rotation, place and shape of the object; degrees and millimetres."""
    from hoigs.core.npz import load_arrays

    arrays = load_arrays(truth_folder / "truth.npz")
    track = made.objects["object"]
    rotations = world[0] @ track.rotations.double().numpy()
    true_rotations = arrays["object_rotations"]
    points = track.points.double().numpy()
    middle = (np.quantile(points, 0.01, axis=0) + np.quantile(points, 0.99, axis=0)) / 2
    places = track.translations.double().numpy() @ world[0].T + world[1] + rotations @ middle
    seen = truth.objects["object"].observed.numpy()
    first = int(np.flatnonzero(seen)[0])
    turned = rotations @ rotations[first].T
    true_turned = true_rotations @ true_rotations[first].T
    off = angles(turned, true_turned)[seen]
    offset = mean_rotation(np.swapaxes(rotations, 1, 2) @ true_rotations)
    best = angles(rotations @ offset, true_rotations)[seen]
    error = places - arrays["object_translations"]
    centers = np.stack([c.center.numpy() for c in truth.cameras]).astype(float)
    view = arrays["object_translations"] - centers
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    along = (error * view).sum(-1)[seen]
    across = np.linalg.norm(error - (error * view).sum(-1, keepdims=True) * view, axis=-1)[seen]
    place = np.linalg.norm(error, axis=-1)[seen]
    truth_points = surface(arrays["object_vertices"], arrays["object_faces"])
    aligned = (points - middle) @ offset
    distance, scale = chamfer(aligned, truth_points)
    turn = np.median(angles(true_turned, np.eye(3)))
    return {
        "rotation_deg": _spread(off), "rotation_best_frame_deg": _spread(best),
        "rotation_none_at_all_deg": round(float(turn), 2),
        "place_mm": _spread(1000 * place, mean=True),
        "place_along_view_mm": round(float(1000 * np.abs(along).mean()), 1),
        "place_across_view_mm": round(float(1000 * across.mean()), 1),
        "chamfer_mm": round(1000 * distance, 1), "size_ratio": round(scale, 3),
        "size_mm": [round(float(v)) for v in 1000 * np.ptp(points, axis=0)],
    }  # fmt: skip


def body_figures(made: Any, truth: Any, body: Any, world: World) -> dict[str, Any]:
    """Joints after aligning the pelvis, wrists in the world, and accelerations of joints."""
    one, two = _joints(body, made) @ world[0].T + world[1], _joints(body, truth)
    off = np.linalg.norm((one - one[:, :1]) - (two - two[:, :1]), axis=-1)
    wrists = np.linalg.norm(one - two, axis=-1)[:, [20, 21]]
    bend = np.diff(one - two, n=2, axis=0) * truth.fps**2
    return {
        "root_aligned_joints_mm": round(float(1000 * off.mean()), 1),
        "joints_mm": round(float(1000 * np.linalg.norm(one - two, axis=-1).mean()), 1),
        "wrists_mm": round(float(1000 * wrists.mean()), 1),
        "acceleration_error_m_s2": round(float(np.linalg.norm(bend, axis=-1).mean()), 2),
    }


def _joints(body: Any, clip: Any) -> np.ndarray:
    """The joints of body, without those of the hands."""
    from hoigs.preparation.body.silhouette import posed

    joints = [j.double().numpy() for _, j in posed(body, clip.bodies["human"].poses)]
    return np.stack(joints)[:, :22]


def camera_motion(made: Any, truth: Any) -> World:
    """The rigid motion that takes a clip's cameras nearest to the true ones. It has no scale: an
    error of the world's scale stays in the figures."""
    ours, true = (
        np.stack([c.world_to_camera.double().numpy() for c in clip.cameras])
        for clip in (made, truth)
    )
    turn = mean_rotation(np.swapaxes(true[:, :3, :3], 1, 2) @ ours[:, :3, :3])
    centers, target = (-np.einsum("fji,fj->fi", m[:, :3, :3], m[:, :3, 3]) for m in (ours, true))
    return turn, (target - centers @ turn.T).mean(0)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between rotations."""
    cosine = (np.einsum("...ij,...ij->...", a, b) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """The rotation nearest to all (chordal distance)."""
    u, _, vt = np.linalg.svd(rotations.sum(0))
    return u @ np.diag((1, 1, np.linalg.det(u @ vt))) @ vt


def surface(vertices: np.ndarray, faces: np.ndarray, count: int = 6000) -> np.ndarray:
    """Evenly spread random points of a mesh."""
    rng = np.random.default_rng(0)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]


def chamfer(points: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Mean of the mean distances both ways after rigid ICP from 25 starts, and the ratio of sizes
    (root mean square distances from the middle)."""
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    points, true = points - points.mean(0), true - true.mean(0)
    rng = np.random.default_rng(0)
    few = points[rng.permutation(len(points))[:1500]]
    tree, best, result = cKDTree(true), np.inf, (np.eye(3), np.zeros(3))
    starts = [np.eye(3), *Rotation.create_group("O").as_matrix()]
    for start in starts:
        turn, shift = start, np.zeros(3)
        for _ in range(15):
            moved = few @ turn.T + shift
            distance, at = tree.query(moved)
            target = true[at]
            a, b = few - few.mean(0), target - target.mean(0)
            turn = mean_rotation((b.T @ a)[None])
            shift = target.mean(0) - turn @ few.mean(0)
        back, _ = cKDTree(moved).query(true[::4])
        both = (distance.mean() + back.mean()) / 2
        if both < best:
            best, result = both, (turn, shift)
    moved = points @ result[0].T + result[1]
    both = (tree.query(moved)[0].mean() + cKDTree(moved).query(true)[0].mean()) / 2
    sizes = [np.sqrt((p**2).sum(-1).mean()) for p in (points, true)]
    return float(both), float(sizes[0] / sizes[1])


def _spread(values: np.ndarray, *, mean: bool = False) -> dict[str, float]:
    middle = ("mean", values.mean()) if mean else ("median", np.median(values))
    found = (middle, ("p95", np.quantile(values, 0.95)), ("worst", values.max()))
    return {name: round(float(value), 2) for name, value in found}


# ---- training


def trained(clip: Path, run: Path, job: Job) -> dict[str, Any]:
    """PSNR by region of test frames and held-out cameras after `job.train` steps, with the body
    poses of test frames as the clip has them ("given"), and interpolated from training frames."""
    from hoigs.evaluation.evaluate import evaluate
    from hoigs.training.session import Session

    session = Session.open(
        clip, "hoigs", out=run, overwrite=True, device=job.device,
        overrides=[
            f"train.steps={job.train}", f"train.width={job.train_width}",
            "train.preview_every=0", f"train.seed={job.seed}",
        ],
    )  # fmt: skip
    start = time.perf_counter()
    session.train()
    seconds = time.perf_counter() - start
    found: dict[str, Any] = {"train_s": round(seconds, 1)}
    if job.pictures:
        draw_views(session, job.pictures / f"{run.name.removesuffix('.run')}.png")
    for poses in ("given", "interpolated"):
        scores = evaluate(session.trainer.model, session.clip, timing_frames=0, test_pose=poses)
        found[f"{poses} poses"] = {
            view.name: {r: _value(scores.score(r, "psnr", view.name)) for r in REGIONS}
            for view in scores.views
        }
    return found


def draw_views(session: Any, file: Path) -> None:
    """Three test frames and three held-out views: the image above, the drawn one below."""
    import torch

    clip, model = session.clip, session.trainer.model.eval()
    chosen = [(clip, p) for p in clip.split["test"]]
    if clip.held_out is not None:
        chosen += [(clip.held_out, p) for p in clip.held_out.split["test"]]
    columns = []
    for views in (chosen[: len(clip.split["test"])], chosen[len(clip.split["test"]) :]):
        for source, position in views[:: max(1, len(views) // 3)][:3]:
            frame = source[position]
            with torch.no_grad():
                drawn = model.render(
                    frame.moment.to(model.device), frame.camera.to(model.device)
                ).color.clamp(0, 1)
            columns.append(torch.cat((frame.rgb.cpu(), drawn.cpu())))
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * torch.cat(columns, 1)).byte().numpy()).save(file)


def _value(score: Any) -> float | str:
    return round(float(score), 2) if isinstance(score, float) else f"not computed: {score}"


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
        )  # fmt: skip


def _add(rows: list[dict[str, Any]], row: dict[str, Any], options: argparse.Namespace) -> None:
    rows.append(row)
    print(_line(row), flush=True)
    if options.json:
        given = {k: str(v) if isinstance(v, Path) else v for k, v in vars(options).items()}
        record = {"settings": given, "rows": rows}
        temporary = options.json.with_name(f".{options.json.name}.{os.getpid()}.part")
        temporary.write_text(json.dumps(record, indent=1) + "\n")
        temporary.replace(options.json)


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: what was estimated, and PSNR of person + object beside the run with all poses."""
    head = (
        "clip", "seed", "joints mm", "wrists mm", "acceleration m/s²", "rotation °", "place mm",
        "Chamfer mm", "path", "path, all given", "held out", "held out, all given",
        "object held out", "object held out, all given",
    )  # fmt: skip
    lines = [head, ["---"] * len(head)]
    for row in rows:
        if "estimated" not in row:
            continue
        found: list[Any] = [
            row["clip"].removeprefix("builtin:").split("?")[0], row["seed"],
            row["root_aligned_joints_mm"], row["wrists_mm"], row["acceleration_error_m_s2"],
            row["rotation_deg"]["median"], row["place_mm"]["mean"], row["chamfer_mm"],
        ]  # fmt: skip
        runs = (row["estimated"]["interpolated poses"], row["every_pose_given"]["given poses"])
        for view, region in (
            ("test frames", "human_object"), ("held-out cameras", "human_object"),
            ("held-out cameras", "object"),
        ):  # fmt: skip
            found += [run[view][region] for run in runs]
        lines.append([str(value) for value in found])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


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
    lines += [f"{name}: {row[name]}" for name in ("estimated", "every_pose_given") if name in row]
    return head + "\n  ".join(["", *lines])


if __name__ == "__main__":
    sys.exit(main())
