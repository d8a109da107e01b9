"""Is `hoigs train --auto` as good as the whole spec, at a seventh of its parameters?

    python benchmarks/auto_against_full.py --jobs 6 --threads 8 --minutes 60
    python benchmarks/auto_against_full.py --clips lift-and-swing --steps 300 --width 64
    python benchmarks/auto_against_full.py --clips clips/juggle --steps 1200 --device cuda

On each clip, a built-in one or the folder of a prepared one, the whole spec is trained, and the
spec that `--auto` finds. Auto passes where its PSNR of people and objects, on test frames and from
held-out cameras (a prepared clip has none), is within 0.2 dB of the whole spec's, with at most 15 %
of its trained numbers and 50 % of its render time. The same command continues a run that was
stopped; render times are measured at the end, when nothing else of this script runs, both models in
turn: of films, which `Playback` draws (on CUDA by captured graphs), and for comparison of
`SceneModel.render`, frame by frame, where a GPU mostly waits for launches.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

from many_cells import read_cell, run_cells, write_cell

CLIPS = ("lift-and-swing", "carry", "throw-and-catch")
KINDS = ("full", "auto")
WITHIN_DB, PARAMETERS, RENDER = 0.20, 0.15, 0.50
ROUNDS = 15  # short ones, both models in each: machines have slow minutes


def clip_of(name: str, options: argparse.Namespace) -> str:
    for clip in options.clips:
        if Path(clip).is_dir() and Path(clip).name == name:
            return clip
    settings = f"?width={options.width}" if options.width else ""
    return f"builtin:{name}{settings}"


def names_of(options: argparse.Namespace) -> list[str]:
    return [Path(clip).name for clip in options.clips]


def run_folder(name: str, kind: str, options: argparse.Namespace) -> Path:
    return options.out / "runs" / f"{name}-{kind}"


def train(name: str, kind: str, options: argparse.Namespace) -> dict[str, Any]:
    """One training, gone on with where it had begun, and its scores on test frames."""
    import hoigs
    from hoigs.evaluation.evaluate import score
    from hoigs.runs.checkpoint import has_checkpoint
    from hoigs.runs.loaded_run import LoadedRun
    from hoigs.runs.run_folder import RunFolder
    from hoigs.studies.needs.compress import compact_of

    run = run_folder(name, kind, options)
    folder, began = RunFolder(run), time.perf_counter()
    settings = [f"train.steps={options.steps}", f"train.seed={options.seed}",
                "train.preview_every=0", *options.set]  # fmt: skip
    begun = folder.path.exists() and has_checkpoint(folder.checkpoints)
    finished = begun and kind == "auto" and bool(folder.read_provenance().get("pruned"))
    answered = run.with_name(f"{run.name}-needs") / "spec.yaml"
    if not finished:
        resume = begun and (kind == "full" or answered.is_file())
        train_it = hoigs.auto if kind == "auto" else hoigs.train
        train_it(
            clip_of(name, options), options.spec, out=run,
            overrides=[] if resume and kind == "auto" else settings, device=options.device,
            resume=resume, overwrite=not resume, evaluate=False,
            report=lambda line: print(line, flush=True),
        )  # fmt: skip
    found: dict[str, Any] = {"seconds": round(time.perf_counter() - began, 1), "resumed": begun}
    for label, path in {"": run, "compact_": compact_of(run)}.items():
        if label and kind == "full":
            continue
        loaded = LoadedRun.open(path, device=options.device)
        scores = score(loaded.model, loaded.clip, timing_frames=0, held_out=not label)
        regions = ("human_object", "human", "object", "full", "background")
        found[f"{label}psnr"] = {region: scores.score(region, "psnr") for region in regions}
        if not label and loaded.clip.held_out is not None:
            cameras = "held-out cameras"
            found["held out"] = {r: scores.score(r, "psnr", cameras) for r in regions}
    loaded = LoadedRun.open(run, device=options.device)
    found["parameters"] = sum(p.numel() for p in loaded.model.parameters() if p.requires_grad)
    found["counts"] = loaded.model.count()
    if kind == "auto":
        data = json.loads((answered.parent / "needs.json").read_text())
        found["because"] = [answer["because"] for answer in data["answers"]]
        found["after"] = data["after"]
    return found


def render_times(name: str, options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Milliseconds a frame of both, two ways, measured in turn, and the shares of auto's in the
    whole spec's: medians of the rounds."""
    from hoigs.evaluation.measure import render_time
    from hoigs.runs.loaded_run import LoadedRun
    from hoigs.viewing.playback import Playback

    loaded = {
        kind: LoadedRun.open(run_folder(name, kind, options), device=options.device)
        for kind in KINDS
    }
    views = {
        kind: [(run.clip.moments[p], run.clip.cameras[p]) for p in run.clip.split["test"]]
        for kind, run in loaded.items()
    }
    films = {kind: Playback(run.model, views[kind]) for kind, run in loaded.items()}
    times: dict[str, dict[str, list[float]]] = {
        way: {kind: [] for kind in KINDS} for way in ("played", "plain")
    }
    for _ in range(ROUNDS):
        for kind, run in loaded.items():
            times["played"][kind].append(film_ms(films[kind], views[kind], options.device))
            positions = list(run.clip.split["test"])
            plain = render_time(run.model, run.clip, positions, frames=len(positions), warmup=1)
            times["plain"][kind].append(plain.total_ms)
    found: dict[str, dict[str, Any]] = {
        way: {kind: round(statistics.median(values), 3) for kind, values in of.items()}
        for way, of in times.items()
    }
    found["share"] = {
        way: statistics.median(a / b for a, b in zip(of["auto"], of["full"], strict=True))
        for way, of in times.items()
    }
    return found | {"modes": {kind: film.mode for kind, film in films.items()}}


def film_ms(film: Any, views: list[Any], device: str) -> float:
    """Milliseconds a frame, without any waiting in between."""
    import torch

    def drawn() -> None:
        for moment, camera in views:
            film(moment, camera)
        if device == "cuda":
            torch.cuda.synchronize()

    drawn()
    began = time.perf_counter()
    drawn()
    return 1000 * (time.perf_counter() - began) / len(views)


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    return {
        name: getattr(options, name) for name in ("spec", "steps", "width", "seed", "set", "device")
    }


def summary(options: argparse.Namespace) -> bool:
    """Print and write the table of the clips that are done; whether all three rules hold on all."""
    from hoigs.studies.jobs.cost import Machine

    rows, good = [], True
    print("| clip | people and objects, dB: full | auto | difference | held out | "
          "parameters | render time | frame by frame | after compressing, dB | "
          "cost in full trainings | |")  # fmt: skip
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---|")
    for name in names_of(options):
        cells = {kind: read_cell(options.out, f"{name}-{kind}", settings_of(options))
                 for kind in KINDS}  # fmt: skip
        full, auto = cells["full"], cells["auto"]
        if full is None or auto is None:
            missing = [kind for kind in KINDS if cells[kind] is None]
            print(f"| {name} | not done: {', '.join(missing)} | | | | | | | | |")
            good = False
            continue
        difference = auto["psnr"]["human_object"] - full["psnr"]["human_object"]
        share = auto["parameters"] / full["parameters"]
        times = render_times(name, options)
        render, plain = (times["share"][way] for way in ("played", "plain"))
        beside = (
            auto["held out"]["human_object"] - full["held out"]["human_object"]
            if "held out" in auto
            else None
        )
        worst = difference if beside is None else min(difference, beside)
        shown = "–" if beside is None else f"{beside:+.2f}"
        passed = worst >= -WITHIN_DB and share <= PARAMETERS and render <= RENDER
        good &= passed
        cost = auto["after"]["full_trainings"]
        rows.append({"clip": name, "difference_db": difference, "held_out_db": beside,
                     "parameters": share, "render": render, "render_ms": times,
                     "passed": passed, **cells})  # fmt: skip
        print(
            f"| {name} | {full['psnr']['human_object']:.2f} | {auto['psnr']['human_object']:.2f} | "
            f"{difference:+.2f} | {shown} | {100 * share:.1f} % | {100 * render:.0f} % | "
            f"{100 * plain:.0f} % | "
            f"{auto['compact_psnr']['human_object']:.2f} | "
            f"{'–' if cost is None else f'{cost:.2f}'} | {'pass' if passed else 'FAIL'} |"
        )
    path = options.out / "summary.json"
    machine = Machine.here(options.device).to_dict()
    found = {"settings": settings_of(options), "machine": machine, "rows": rows}
    path.write_text(json.dumps(found, indent=1))
    print(f"wrote {path}")
    return good


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--clips", nargs="+", default=list(CLIPS), help="names of built-in ones, or folders"
    )
    parser.add_argument("--spec", default="hoigs")
    parser.add_argument("--steps", type=int, default=2000, help="of each training")
    parser.add_argument("--width", type=int, help="of the clips' frames; default: their own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], help="of both trainings")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    parser.add_argument("--threads", type=int, default=1, help="of each")
    parser.add_argument("--minutes", type=float, help="stop then; the same command goes on")
    parser.add_argument("--out", type=Path, default=Path("runs/auto-against-full"))
    parser.add_argument("--summary", action="store_true", help="only read what is done")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> int:
    options = parse()
    if options.cell is not None:
        name, _, kind = options.cell.rpartition("-")
        write_cell(options.out, options.cell, settings_of(options), train(name, kind, options))
        return 0
    cells = [f"{name}-{kind}" for kind in reversed(KINDS) for name in names_of(options)]
    if not options.summary:
        own = [f"--spec={options.spec}", f"--steps={options.steps}", f"--seed={options.seed}",
               f"--out={options.out}", f"--device={options.device}", "--clips", *options.clips,
               *(f"--set={text}" for text in options.set)]  # fmt: skip
        own += [f"--width={options.width}"] if options.width else []
        run_cells(
            cells, options.out, settings_of(options), own, jobs=options.jobs,
            threads=options.threads, minutes=options.minutes,
        )  # fmt: skip
    return 0 if summary(options) else 1


if __name__ == "__main__":
    sys.exit(main())
