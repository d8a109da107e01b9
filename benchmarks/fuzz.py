"""Damage every kind of file that hoigs reads, thousands of times, and see how it is answered.

    python benchmarks/fuzz.py --count 10000 --json benchmarks/results/fuzz.json
    python benchmarks/fuzz.py --only clips --seed 17 --count 1     # one case again

A case is right if the file is read, or refused by an error that the command line prints as a
sentence (`hoigs.cli.failures.message_of`), within 10 seconds of a processor and 1 GiB, with nothing
written and nothing run. Some damages carry a pickle that would write a file. Exit code 1 if any
case is wrong.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.fuzz_damages import MARK, damaged
from benchmarks.fuzz_layouts import write_layouts
from hoigs.cli.failures import message_of

SECONDS, GIB = 10.0, 1.0


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Attributes:
        files: relative paths that are damaged in turn. read: from the folder that holds them.
    """

    name: str
    folder: Path
    files: tuple[str, ...]
    read: Callable[[Path], object]


@dataclass
class Outcome:
    """What became of the cases of one target; `wrong` has a line for each wrong one."""

    cases: int = 0
    read: int = 0
    refused: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    wrong: list[str] = field(default_factory=list)


def try_one(target: Target, rng: random.Random, outcome: Outcome) -> None:
    """Damage one file of a target, read it, and put it back.

    Raises:
        AssertionError: the case is wrong; the message says how.
    """
    name = rng.choice(target.files)
    path = target.folder / name
    before, mark = path.read_bytes(), target.folder / MARK
    made = damaged(path, before, rng, mark)
    state = _listing(target.folder)
    peak, began = _peak(), time.process_time()
    outcome.cases += 1
    try:
        path.write_bytes(made)
        target.read(target.folder)
        outcome.read += 1
    except Exception as error:
        message = message_of(error)
        where = traceback.format_exc(limit=-4)
        assert message is not None, f"{name}: {type(error).__name__}: {error}\n{where}"
        assert len(message) < 10_000, f"{name}: a message of {len(message)} characters"
        outcome.refused += 1
        outcome.errors[type(error).__name__] += 1
    finally:
        path.write_bytes(before)
    seconds = time.process_time() - began  # others may keep the machine busy
    outcome.slowest_s = max(outcome.slowest_s, round(seconds, 2))
    assert seconds < SECONDS, f"{name}: {seconds:.1f} s"
    assert _peak() - peak < GIB * 2**30, f"{name}: {(_peak() - peak) / 2**30:.2f} GiB"
    assert not mark.exists(), f"{name}: its code was run"
    assert _listing(target.folder) == state, f"{name}: something was written"


def _peak() -> int:
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else 1024 * used


def _listing(folder: Path) -> list[str]:
    return sorted(str(p) for p in folder.rglob("*"))


def make_targets(root: Path, clip: Path) -> list[Target]:
    """Every kind of input, as small as it can be.

    Args:
        clip: a clip folder with a person and an object, which is copied.
    """
    from hoigs.core.spec.files import BUILTIN_SPECS
    from hoigs.training.session import Session

    for name in ("specs", "options", "shapes"):
        (root / name).mkdir()
    for name in ("hoigs", "static", "4dgs"):
        shutil.copy(BUILTIN_SPECS / f"{name}.yaml", root / "specs")
    (root / "options" / "options.yaml").write_text(OPTIONS)
    (root / "options" / "options.toml").write_text(OPTIONS_TOML)
    _make_shapes(root / "shapes")
    shutil.copytree(clip, root / "clips" / "clip")
    shutil.copytree(clip, root / "runs" / "clip")
    shutil.copytree(clip, root / "checkpoints" / "clip")
    settings = ["train.steps=2", "train.checkpoint_every=1", "train.log_every=1",
                "train.preview_every=0", "model.scene.points=60"]  # fmt: skip
    more = ["model.human.points=60", "model.object.points=60"]
    for place, spec, own in (("runs", "static", []), ("checkpoints", "hoigs", more)):
        folder = root / place
        Session.open(folder / "clip", spec, out=folder / "run", overrides=[*settings, *own]).train()
    stem = "run/checkpoints/step_000002"
    inside = tuple(
        f"clip/{p.relative_to(clip)}"
        for p in sorted(clip.rglob("*"))
        if p.suffix in (".json", ".npz") and "depth" not in p.parts
    )
    pixels = tuple(f"clip/{p.relative_to(clip)}" for p in sorted(clip.rglob("*00002.*")))
    return [
        Target("specs", root / "specs", ("hoigs.yaml", "static.yaml", "4dgs.yaml"), _read_specs),
        Target("options", root / "options", ("options.yaml", "options.toml"), _read_options),
        Target("shapes", root / "shapes", ("a.ply", "b.ply", "c.obj"), _read_shapes),
        Target("clips", root / "clips", (*inside, *pixels), _read_clip),
        Target("runs", root / "runs", ("run/provenance.json", "run/metrics.jsonl",
                                       "run/spec.yaml"), _read_run),
        Target("checkpoints", root / "checkpoints", (f"{stem}.json", f"{stem}.safetensors"),
               _read_run),
        *(Target(*layout) for layout in write_layouts(root, clip)),
    ]  # fmt: skip


OPTIONS_TOML = """width = 320
[estimators.masks]
use = "estimator:masks-files"
path = "masks"
"""
OPTIONS = """width: 320
camera: static
max_frames: 20
estimators:
  masks: {use: "estimator:masks-files", path: masks}
  depth: {use: "estimator:depth-files", path: depth}
"""


def _make_shapes(folder: Path) -> None:
    import trimesh

    box = trimesh.creation.box()
    (folder / "a.ply").write_bytes(box.export(file_type="ply", encoding="ascii"))
    (folder / "b.ply").write_bytes(box.export(file_type="ply"))
    (folder / "c.obj").write_text(box.export(file_type="obj"))


def _read_specs(folder: Path) -> None:
    from hoigs.core.spec.schema import Spec

    for path in sorted(folder.glob("*.yaml")):
        Spec.load(path)


def _read_options(folder: Path) -> None:
    from hoigs.preparation.estimates.installed import load_options

    for path in sorted(folder.iterdir()):
        load_options(path)


def _read_shapes(folder: Path) -> None:
    from hoigs.plugins.initializers.shapes import read_points, sample_mesh

    for path in sorted(folder.iterdir()):
        read_points(path, 0.05)
        sample_mesh(path, 20, 0)


def _read_clip(folder: Path) -> None:
    from hoigs.evaluation.geometry import read_truth
    from hoigs.runs.clip_source import read_clip

    clip = read_clip(folder / "clip")
    for position in (0, 2):
        frame = clip[position]
        assert frame.image.shape[:2] == (clip.cameras[0].height, clip.cameras[0].width)
        assert frame.masks is not None
    read_truth(clip)


def _read_run(folder: Path) -> None:
    from hoigs.runs.loaded_run import LoadedRun
    from hoigs.runs.run_folder import RunFolder

    loaded = LoadedRun.open(folder / "run")
    RunFolder(folder / "run").read_metrics()
    output = loaded.model.render(loaded.clip.moments[0], loaded.clip.cameras[0])
    assert torch.isfinite(output.color).all(), "the render is not finite"


def run(
    targets: Sequence[Target], count: int, seed: int, limit_s: float = math.inf
) -> dict[str, Outcome]:
    """`count` cases of each target, or as many as the time allows; the seed of case i is seed + i.

    Args:
        limit_s: seconds for each target.
    """
    outcomes = {}
    for target in targets:
        outcome = outcomes[target.name] = Outcome()
        until = time.perf_counter() + limit_s
        for i in range(count):
            if time.perf_counter() > until:
                break
            try:
                try_one(target, random.Random(f"{target.name}{seed + i}"), outcome)
            except AssertionError as error:
                outcome.wrong.append(f"{target.name} seed {seed + i}: {error}")
                print(outcome.wrong[-1], file=sys.stderr, flush=True)
        print(f"{target.name}: {outcome.cases} cases, {outcome.read} read, {outcome.refused} "
              f"refused, {len(outcome.wrong)} wrong", flush=True)  # fmt: skip
    return outcomes


def shared_out(arguments: argparse.Namespace, limit_s: float) -> tuple[dict[str, Any], float]:
    """The same by several processes, each with its own part of the seeds: their outcomes joined,
    and the largest peak of memory."""
    jobs, each = arguments.jobs, math.ceil(arguments.count / arguments.jobs)
    only = ["--only", *arguments.only] if arguments.only else []
    small_clip_folder()
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{k}.json" for k in range(jobs)]
        minutes = [] if limit_s == math.inf else ["--minutes", str(limit_s / 60)]
        running = [
            subprocess.Popen(
                [sys.executable, __file__, "--count", str(each), "--seed",
                 str(arguments.seed + k * each), "--json", str(file), *minutes, *only]
            )
            for k, file in enumerate(files)
        ]  # fmt: skip
        for process in running:
            process.wait()
        records = [json.loads(file.read_text()) for file in files]
    joined: dict[str, Any] = {}
    for name in records[0]["targets"]:
        parts = [record["targets"][name] for record in records]
        joined[name] = {
            **{key: sum(part[key] for part in parts) for key in ("cases", "read", "refused")},
            "errors": dict(sum((Counter(part["errors"]) for part in parts), Counter())),
            "slowest_s": max(part["slowest_s"] for part in parts),
            "wrong": [case for part in parts for case in part["wrong"]],
        }
    return joined, max(record["peak_gib"] for record in records)


def small_clip_folder() -> Path:
    """The built-in clip at its smallest, generated once and cached."""
    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.synthesis import SceneConfig, builtin_clip

    return builtin_clip(AnnyBody(), SceneConfig.tiny())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--count", type=int, default=10_000, help="cases in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", help="names of targets")
    parser.add_argument("--minutes", type=float, help="stop after this time, all targets alike")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the cases")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    limit = math.inf if arguments.minutes is None else 60 * arguments.minutes
    torch.set_num_threads(1)
    began = time.perf_counter()
    if arguments.jobs > 1:
        found, peak = shared_out(arguments, limit)
    else:
        with tempfile.TemporaryDirectory() as folder:
            targets = make_targets(Path(folder), small_clip_folder())
            chosen = [t for t in targets if not arguments.only or t.name in arguments.only]
            each = max(1, math.ceil(arguments.count / len(chosen)))
            outcomes = run(chosen, each, arguments.seed, limit / len(chosen))
        found = {name: vars(outcome) for name, outcome in outcomes.items()}
        peak = round(_peak() / 2**30, 2)
    if arguments.json:
        record = {
            "command": " ".join(["python benchmarks/fuzz.py", *sys.argv[1:]]),
            "cases": sum(outcome["cases"] for outcome in found.values()),
            "seconds": round(time.perf_counter() - began),
            "peak_gib": peak,
            "targets": found,
        }
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")
    if any(outcome["wrong"] for outcome in found.values()):
        sys.exit(1)


if __name__ == "__main__":
    os.environ.setdefault("HOIGS_PLUGINS", "0")
    main()
