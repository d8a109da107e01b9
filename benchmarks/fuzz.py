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
import contextlib
import copy
import io
import json
import math
import os
import pickle
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from hoigs.cli.failures import message_of

SECONDS, GIB = 10.0, 1.0
MARK = "code-was-run"
ODD_NUMBERS = (0, -1, 1, 2**31, 10**12, -(10**18), 1e30, math.inf, -math.inf, math.nan, 0.5)
ODD_TEXTS = ("", "x" * 5000, "../../x", "/etc/passwd", "a\0b", "\x1b[31m", "body:anny", "é\u202e")
YAML = ("&a [*a]", "!!python/object/apply:os.system [x]", "<<: {a: 1}", "\t")
ODD_BYTES = (b"", b"\0" * 64, b"\xff\xfe\x00", b"[" * 60_000, b"{}", b"PK\x03\x04", b"\x93NUMPY")


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


class _Payload:
    """A pickle that writes a file when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return (open, (str(self.mark), "w"))


def try_one(target: Target, rng: random.Random, outcome: Outcome) -> None:
    """Damage one file of a target, read it, and put it back.

    Raises:
        AssertionError: the case is wrong; the message says how.
    """
    name = rng.choice(target.files)
    path = target.folder / name
    before, mark = path.read_bytes(), target.folder / MARK
    damaged = _damaged(path, before, rng, mark)
    state = _listing(target.folder)
    peak, began = _peak(), time.process_time()
    outcome.cases += 1
    try:
        path.write_bytes(damaged)
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


def _damaged(path: Path, data: bytes, rng: random.Random, mark: Path) -> bytes:
    """The content of a file after a random damage of its kind, or of its bytes."""
    kinds: list[Callable[[], bytes]] = [lambda: _bytes(data, rng, mark)]
    if path.suffix in (".json", ".jsonl"):
        kinds += 4 * [lambda: _json(data, rng)]
    elif path.suffix == ".npz":
        kinds += 4 * [lambda: _npz(data, rng, mark)]
    elif path.suffix == ".safetensors":
        kinds += 4 * [lambda: _safetensors(path, rng)]
    elif path.suffix in (".yaml", ".toml", ".ply", ".obj"):
        kinds += 4 * [lambda: _words(data, rng)]
    return rng.choice(kinds)()


def _bytes(data: bytes, rng: random.Random, mark: Path) -> bytes:
    at = rng.randrange(len(data) + 1)
    choice = rng.randrange(6)
    if choice == 0:
        return data[:at]
    if choice == 1:
        return rng.choice(ODD_BYTES)
    if choice == 2:
        return pickle.dumps(_Payload(mark))
    if choice == 3:
        return data[:at] + rng.randbytes(rng.randint(1, 40)) + data[at:]
    if choice == 4:
        return data[:at] + data[at + rng.randint(1, 40) :]
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def _odd(rng: random.Random) -> Any:
    deep: Any = []
    for _ in range(rng.choice((3, 500))):
        deep = [deep]
    return rng.choice(
        (*ODD_NUMBERS, *ODD_TEXTS, None, True, [], {}, [1, "x"], {"use": 3}, deep,
         list(range(20_000)))
    )  # fmt: skip


def _json(data: bytes, rng: random.Random) -> bytes:
    """JSON with a value replaced, removed or doubled under another key."""
    lines = (
        data.decode().splitlines() if data[:1] == b"{" and data.count(b"}\n{") else [data.decode()]
    )
    number = rng.randrange(len(lines))
    tree = json.loads(lines[number])
    for _ in range(rng.choice((1, 1, 1, 3))):
        places = list(_places(tree))
        if not places:
            break
        holder, key = rng.choice(places)
        action = rng.randrange(4)
        if action == 0:
            del holder[key]
        elif action == 1 and isinstance(holder, dict):
            with contextlib.suppress(RecursionError):  # an earlier damage may be this deep
                holder[rng.choice(ODD_TEXTS)] = copy.deepcopy(holder[key])
        else:
            holder[key] = _odd(rng)
    lines[number] = json.dumps(tree if rng.random() > 0.03 else _odd(rng))
    return "\n".join(lines).encode() + b"\n"


def _places(tree: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    todo = [tree]
    while todo and len(found) < 3000:
        node = todo.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node))
        if isinstance(node, dict | list):
            for key in keys:
                found.append((node, key))
                if isinstance(node[key], dict | list):
                    todo.append(node[key])
    return found


def _words(data: bytes, rng: random.Random) -> bytes:
    """Text with a word or a line replaced, removed or moved."""
    lines = data.decode("utf-8", "replace").split("\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(" ")
    choice = rng.randrange(5)
    if choice == 0:
        lines[at] = rng.choice(
            ("&a [*a]", "!!python/object/apply:os.system [x]", "<<: {a: 1}", "\t")
        )
    elif choice == 1:
        del lines[at]
    elif choice == 2:
        lines.insert(rng.randrange(len(lines)), lines[at])
    else:
        odd = rng.choice((*ODD_NUMBERS, *ODD_TEXTS, "[", "{", ":", ".inf", "999999999999"))
        words[rng.randrange(len(words))] = str(odd)
        lines[at] = " ".join(words)
    return "\n".join(lines).encode("utf-8", "replace")


def _npz(data: bytes, rng: random.Random, mark: Path) -> bytes:
    """An npz with an array of other values, shape or dtype, a header that lies, or a pickle."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice(list(arrays))
    choice = rng.randrange(9)
    array = arrays[name]
    raw: bytes | None = None
    if choice == 0:
        del arrays[name]
    elif choice == 1 and array.size and array.dtype.kind == "f":
        arrays[name] = array.copy()
        arrays[name].flat[rng.randrange(array.size)] = rng.choice(ODD_NUMBERS[:3] + ODD_NUMBERS[6:])
    elif choice == 2:
        arrays[name] = array.astype(rng.choice(("U8", "i8", "f2", "c16", "?"))) if (
            array.dtype.kind in "fb") else np.array(7.0)  # fmt: skip
    elif choice == 3:
        arrays[name] = array[..., None]
    elif choice == 4 and array.ndim:
        arrays[name] = array[: rng.randrange(len(array) + 1)]
    elif choice == 5:
        arrays[name] = np.array([_Payload(mark)], dtype=object)
    elif choice == 6:
        arrays[rng.choice(("../x", "extra", "a/b"))] = array
    elif choice == 7:
        shape = rng.choice(((10**12,), (-1, 3), (10**9, 10**9), (2**70,), ()))
        raw = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            raw, {"descr": "<f4", "fortran_order": False, "shape": shape}
        )
        raw = raw.getvalue() + b"\0" * 64
    else:
        arrays[name] = np.zeros((0, *array.shape[1:]), array.dtype)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, values in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, values, allow_pickle=True)
            archive.writestr(f"{key}.npy", raw if raw and key == name else buffer.getvalue())
    return out.getvalue()


def _safetensors(path: Path, rng: random.Random) -> bytes:
    """A checkpoint with a tensor of other values, shape or dtype, or without it."""
    tensors = load_file(path)
    name = rng.choice(list(tensors))
    value, choice = tensors[name].clone(), rng.randrange(6)
    if choice == 0:
        del tensors[name]
    elif choice == 1 and value.numel():
        odd = rng.choice(ODD_NUMBERS) if value.is_floating_point() else rng.randrange(256)
        value.view(-1)[rng.randrange(value.numel())] = odd
        tensors[name] = value
    elif choice == 2:
        tensors[name] = value.to(rng.choice((torch.int64, torch.float16, torch.bool)))
    elif choice == 3:
        tensors[name] = value[None].contiguous()
    elif choice == 4 and value.dim():
        tensors[name] = value[: rng.randrange(len(value) + 1)].contiguous()
    else:
        tensors["model.other"] = value
    with tempfile.TemporaryDirectory() as folder:
        save_file(tensors, Path(folder) / "x")
        return (Path(folder) / "x").read_bytes()


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
    from hoigs.preparation.settings import load_options

    for path in sorted(folder.iterdir()):
        load_options(path)


def _read_shapes(folder: Path) -> None:
    from hoigs.plugins.initializers.shape_files import read_points, sample_mesh

    for path in sorted(folder.iterdir()):
        read_points(path, 0.05)
        sample_mesh(path, 20, 0)


def _read_clip(folder: Path) -> None:
    from hoigs.evaluation.truth import read_truth
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
