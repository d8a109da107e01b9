"""Kill `prepare` at random moments, and check that every next run continues.

    python benchmarks/kill_prepare.py --times 50

A tiny made-up source is prepared once, unbroken. Then processes prepare it anew and are killed
(SIGKILL) after a random part of that time, more often early than late. After each kill the target
must be absent or whole; a run that completes must have written the same bytes as the unbroken one
(but for the seconds in its reports), and must have left no other file. Each process is
forked from one that has only imported hoigs, so that the kills fall into the work and not into
`import torch`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import torch
import torch._dynamo  # what an optimizer's first step imports, for seconds

from hoigs.core.clip_folder.check import check_clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.preparation.prepare import PrepareOptions, prepare, work_folder
from hoigs.preparation.stages.plan import PLAN

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/preparation"))
from tiny import FRAMES, make_source, picture

NUMBERS = "report.json"  # compared without the seconds that stages took
TIMED = {"report.md", "report.html"}  # the same numbers, seconds among them


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=50, help="kills")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        report = kill_often(Path(folder), args.times, random.Random(args.seed))
    print(report)


def kill_often(folder: Path, times: int, dice: random.Random) -> str:
    """Kills so many runs; what was seen, in words.

    Raises:
        AssertionError: something was half-written, or a run that went on gave something else.
    """
    source = make_source(folder / "source", tiny_video(folder))
    start = time.perf_counter()
    assert finished(source, folder / "unbroken/clip", None), "the unbroken run failed"
    seconds = time.perf_counter() - start
    unbroken = folder / "unbroken/clip"
    out = folder / "killed/clip"
    kills, whole, resumed, last = 0, 0, 0, Counter[str]()
    while kills < times:
        went_on = bool(stored(out))
        done = finished(source, out, 1.2 * seconds * dice.random() ** 2)
        if out.exists():
            problems = check_clip(out)
            assert not problems, f"half a clip: {problems}"
            same(out, unbroken)
        if not done:
            kills += 1
            last[(stored(out) or ["nothing yet"])[-1]] += 1
        if done or (kills == times and not out.exists()):
            if not done:
                assert finished(source, out, None), "the last run failed"
            same(out, unbroken)
            beside = sorted(p.name for p in out.parent.iterdir())
            assert beside == ["clip", "clip.prepare"], beside
            whole, resumed = whole + 1, resumed + went_on
        if out.exists():
            shutil.rmtree(out.parent)
    places = ", ".join(f"{name} {last[name]}" for name in ("nothing yet", *PLAN) if last[name])
    return (
        f"{kills} kills in runs of {seconds:.1f} s: {whole} clips finished, {resumed} of them by a "
        f"run that went on where a killed one was; all equal to the unbroken one, none half-written"
        f"\nlast stage kept when killed: {places}"
    )


def finished(source: Path, out: Path, seconds: float | None) -> bool:
    """Whether a process that prepares `source` got to its end within `seconds`, or was killed."""
    out.parent.mkdir(parents=True, exist_ok=True)
    child = os.fork()
    if child == 0:
        code = 1
        try:
            options = PrepareOptions(fit_steps=5, overlay_width=0)
            prepare(source, out, body=AnnyBody(), options=options)
            code = 0
        finally:
            os._exit(code)
    end = time.perf_counter() + (seconds if seconds is not None else 600)
    while time.perf_counter() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            assert status == 0, f"prepare failed, status {status}"
            return True
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def stored(out: Path) -> list[str]:
    """Stages whose result is kept, in order."""
    return [name for name in PLAN if (work_folder(out) / name).is_dir()]


def contents(clip: Path) -> dict[str, str]:
    """SHA-256 of every file, of the report's numbers without times; "" for their renderings."""
    found = {}
    for path in sorted(p for p in clip.rglob("*") if p.is_file()):
        content = path.read_bytes()
        if path.name == NUMBERS:
            numbers = {k: v for k, v in json.loads(content).items() if k != "seconds"}
            content = json.dumps(numbers, sort_keys=True).encode()
        digest = "" if path.name in TIMED else hashlib.sha256(content).hexdigest()
        found[str(path.relative_to(clip))] = digest
    return found


def same(clip: Path, unbroken: Path) -> None:
    """AssertionError, naming the files, if two clips differ."""
    found, expected = contents(clip), contents(unbroken)
    other = {p for p in {*found, *expected} if found.get(p) != expected.get(p)}
    assert not other, f"not what the unbroken run made: {sorted(other)}"


def tiny_video(folder: Path) -> Path:
    from hoigs.preparation.report.video_out import VideoWriter

    path = folder / "tiny.mp4"
    with VideoWriter(path, fps=12, crf=8) as video:
        for i in range(FRAMES):
            video.add(picture(i))
    return path


if __name__ == "__main__":
    main()
