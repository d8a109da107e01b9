"""How long this tree takes against another commit's, on a CPU, in turns.

    python benchmarks/against_commit.py --commit 8e71855 --json against-commit.json
    make bench BENCH_COMMIT=8e71855

The commit is checked out beside this tree for as long as it takes. Two processes, one of each tree,
open the same run of the demo and train it past its first steps. Then they take turns: one works
while the other waits, and who begins changes from round to round, so that whatever else the machine
does falls on both alike. What is compared in each round:

    step     a training step of `hoigs demo` (built-in clip, 256x256, spec hoigs)
    human    forward and backward of deformation:hexplane-skinning alone, as in training
    forward  its forward pass alone
    pose     the same in evaluation: what depends on no moment is computed once
    frame    a picture of a film: `Playback`, from the moment to the image

Ratios are those of a round, time of the commit over time of this tree; printed are their median and
quartiles, by the clock and by the time that processors worked (of all threads; waiting threads that
spin count as work).
"""

from __future__ import annotations

import argparse
import copy
import importlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
STEPS = 800  # of the demo
COUNTS = {"step": 5, "human": 4, "forward": 4, "pose": 10, "frame": 5}


def serve(options: argparse.Namespace) -> None:
    """The process of one tree: reads names of measures, writes milliseconds of one pass."""
    import torch

    torch.set_num_threads(options.threads)
    for module in ("threads", "memory"):  # as the command line does; where older trees have it
        with suppress(ImportError, AttributeError):
            importlib.import_module(f"hoigs.core.system.{module}").keep_freed_memory()
    from hoigs.training.session import Session
    from hoigs.viewing.playback import Playback

    settings = [
        f"train.steps={STEPS}", f"train.checkpoint_every={10 * STEPS}",
        f"train.log_every={10 * STEPS}", "train.preview_every=0", *options.overrides,
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as scratch:
        session = Session.open(
            options.clip, "hoigs", out=Path(scratch) / "run", overrides=settings, device="cpu",
            overwrite=True,
        )  # fmt: skip
        trainer = session.trainer
        model, clip = trainer.model, session.clip
        trainer.train(until=options.warmup)
        human, finished = model.entity("human"), copy.deepcopy(model).eval().entity("human")
        views = list(zip(clip.moments, clip.cameras, strict=True))
        play = Playback(model, views[:4], mode="cached")
        model.train()
        done = 0

        def moment() -> Any:
            nonlocal done
            done += 1
            return views[7 * done % len(views)]

        def forward_and_backward() -> None:
            made = human(moment()[0])
            sum((x * x.detach()).sum() for x in vars(made).values() if x is not None).backward()
            model.zero_grad(set_to_none=True)

        def pose() -> None:
            with torch.no_grad():
                for _ in range(COUNTS["pose"]):
                    finished(moment()[0])

        measures: dict[str, Callable[[], Any]] = {
            "step": lambda: trainer.train(until=trainer.step + COUNTS["step"]),
            "human": lambda: [forward_and_backward() for _ in range(COUNTS["human"])],
            "forward": lambda: [human(moment()[0]) for _ in range(COUNTS["forward"])],
            "pose": pose,
            "frame": lambda: [play(*moment()) for _ in range(COUNTS["frame"])],
        }
        for measure in measures.values():
            measure()
        say({"ready": True, "splats": model.count()})
        for line in sys.stdin:
            name = line.strip()
            clock, worked = time.perf_counter(), time.process_time()
            measures[name]()
            wall, cpu = time.perf_counter() - clock, time.process_time() - worked
            say({"wall": 1e3 * wall / COUNTS[name], "cpu": 1e3 * cpu / COUNTS[name]})


def say(answer: dict[str, Any]) -> None:
    print(f"answer {json.dumps(answer)}", flush=True)


class Tree:
    """A process that measures one tree."""

    def __init__(self, root: Path, arguments: list[str]) -> None:
        command = [sys.executable, __file__, "--serve", *arguments]
        environment = {**os.environ, "PYTHONPATH": str(root)}
        self.process = subprocess.Popen(
            command, cwd=root, env=environment, text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )  # fmt: skip

    def answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("answer "):
                found: dict[str, Any] = json.loads(line.removeprefix("answer "))
                return found
        raise SystemExit(f"{self.process.args} ended with {self.process.wait()}; see above")

    def measure(self, name: str) -> dict[str, float]:
        assert self.process.stdin is not None
        self.process.stdin.write(name + "\n")
        self.process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """A worktree of a commit, removed afterwards."""
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "tree"
        subprocess.run([*git, "add", "--quiet", "--detach", str(folder), commit], check=True)
        try:
            yield folder
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def revision(commit: str) -> str:
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", commit]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def compare(old: Tree, new: Tree, rounds: int) -> dict[str, Any]:
    """Milliseconds and ratios of every measure."""
    rows: dict[str, list[tuple[dict[str, float], dict[str, float]]]] = {n: [] for n in COUNTS}
    for number in range(rounds):
        for name, found in rows.items():
            pair = {}
            for tree in (old, new) if number % 2 else (new, old):
                pair[tree] = tree.measure(name)
            found.append((pair[old], pair[new]))
    report: dict[str, Any] = {}
    for name, found in rows.items():
        for kind in ("wall", "cpu"):
            ratios = [a[kind] / b[kind] for a, b in found]
            low, middle, high = statistics.quantiles(ratios, n=4, method="inclusive")
            report.setdefault(name, {})[kind] = {
                "commit_ms": round(statistics.median(a[kind] for a, _ in found), 2),
                "tree_ms": round(statistics.median(b[kind] for _, b in found), 2),
                "ratio": round(middle, 3),
                "quartiles": [round(low, 3), round(high, 3)],
            }
    return report


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commit", help="to compare with")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--warmup", type=int, default=120, help="training steps before")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--set", dest="overrides", nargs="*", default=[], help="of the spec")
    parser.add_argument("--clip", default="builtin:lift-and-swing")
    parser.add_argument("--json", type=Path, help="where the figures are written")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options)
        return
    if options.commit is None:
        parser.error("--commit is missing: the commit to compare this tree with")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the checkout goes then, too
    sys.path.insert(0, str(ROOT))
    import torch

    from benchmarks.at_size import machine, write
    from hoigs.runs.clip_source import clip_folder

    arguments = [
        "--clip", str(clip_folder(options.clip)), "--warmup", str(options.warmup),
        "--threads", str(options.threads), "--set", *options.overrides,
    ]  # fmt: skip
    with checked_out(options.commit) as folder, ExitStack() as processes:
        trees = []
        for root in (folder, ROOT):
            tree = Tree(root, arguments)
            processes.callback(tree.close)
            trees.append((tree, tree.answer()))
        (old, _), (new, ready) = trees
        measured = compare(old, new, options.rounds)
    report = {
        "machine": machine(torch.device("cpu")) | {"threads": options.threads},
        "commit": revision(options.commit),
        "tree": revision("HEAD"),
        "splats": ready["splats"],
        "rounds": options.rounds,
        "measured": measured,
    }
    print(f"{report['commit']} over {report['tree']}, {options.threads} threads; ms and ratio")
    for name, kinds in measured.items():
        for kind, row in kinds.items():
            low, high = row["quartiles"]
            print(
                f"{name:9}{kind:5}{row['commit_ms']:9.2f}{row['tree_ms']:9.2f}"
                f"{row['ratio']:8.2f}  ({low:.2f} to {high:.2f})"
            )
    write(report, options.json)


if __name__ == "__main__":
    main()
