"""Kill `prepare` at random moments, and check that every next run continues.

    python benchmarks/kill_prepare.py --times 50
    python benchmarks/kill_prepare.py --install --times 30 --json prepare-kills.json

A tiny made-up source is prepared once, unbroken. Then processes prepare it anew and are killed
(SIGKILL) after a random part of that time, more often early than late. After each kill the target
must be absent or whole; a run that completes must have written the same bytes as the unbroken one
(but for the seconds in its reports), and must have left no other file. With `--install` the video
lies alone: each run first installs the environment of `estimator:mediapipe`, by the real venv and
pip but of one local wheel that plays MediaPipe, and runs its script there. Every other kill is of
the whole process group, the others of the process alone, as the kernel does where memory is short:
what it had started must end by itself, while the next run is already at work. Each process is
forked from one that has only imported hoigs, so that the kills fall into the work and not into
`import torch`.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch._dynamo  # what an optimizer's first step imports, for seconds

from hoigs.core.clip_folder.check import check_clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.estimators.tools import MEDIAPIPE
from hoigs.preparation.kept import PLAN
from hoigs.preparation.prepare import PrepareOptions, prepare, work_folder

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/preparation"))
from tiny import FRAMES, landmarks, make_source, picture
from tiny_mediapipe import FAKE, FAKE_CV2, FAKE_LOOK, FAKE_MODEL

NUMBERS = "report.json"  # compared without the seconds that stages took
TIMED = {"report.md", "report.html"}  # the same numbers, seconds among them


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=50, help="kills")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--install", action="store_true", help="install the environment, too")
    parser.add_argument("--json", type=Path, help="file for the numbers")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        if args.install:
            record = kill_installations(Path(folder), args.times, random.Random(args.seed))
            record = {"command": f"--install --times {args.times} --seed {args.seed}", **record}
            report = table(record)
            if args.json:
                args.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        else:
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


def finished(source: Path, out: Path, seconds: float | None, group: bool = True) -> bool:
    """Whether a process that prepares `source` got to its end within `seconds`, or was killed, with
    its process group or alone."""
    out.parent.mkdir(parents=True, exist_ok=True)
    child = os.fork()
    if child == 0:
        code = 1
        os.setsid()
        try:
            alone = source.is_file()
            options = PrepareOptions(
                fit_steps=5, overlay_width=0, camera="static" if alone else "auto"
            )
            nothing = "none" if alone else ()
            prepare(source, out, body=AnnyBody(), options=options, object=nothing, yes=True)
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
    kill = os.killpg if group else os.kill
    kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def kill_installations(folder: Path, times: int, dice: random.Random) -> dict[str, Any]:
    """As `kill_often`, of a video alone and an empty cache.

    Raises:
        AssertionError: likewise; or a process, a temporary file or a held lock outlived the runs.
    """
    root = folder / "cache/environments/mediapipe"
    video = use_local_mediapipe(folder)
    start = time.perf_counter()
    assert finished(video, folder / "unbroken/clip", None), "the unbroken run failed"
    seconds = time.perf_counter() - start
    unbroken, out = folder / "unbroken/clip", folder / "killed/clip"
    expected = {MEDIAPIPE.folder.name, "lock"}
    record: dict[str, Any] = {"unbroken_s": round(seconds, 1), "kills": 0, "finished": 0,
                              "went_on": 0, "killed_in": {}}  # fmt: skip
    shutil.rmtree(root)
    while record["kills"] < times:
        went_on = root.exists()
        group = record["kills"] % 2 == 0
        if finished(video, out, seconds * dice.random(), group):
            done = True
        else:
            record["kills"] += 1
            place = where(root, out)
            record["killed_in"][place] = record["killed_in"].get(place, 0) + 1
            done = record["kills"] == times and finished(video, out, None)
        if out.exists():
            assert not check_clip(out), f"half a clip: {check_clip(out)}"
        if done:
            same(out, unbroken)
            beside = sorted(p.name for p in out.parent.iterdir())
            assert beside == ["clip", "clip.prepare"], beside
            assert {p.name for p in root.iterdir()} == expected, sorted(root.iterdir())
            hidden = [p for p in (out.parent, root) for p in p.glob("**/*.part")]
            assert not hidden, hidden
            record["finished"] += 1
            record["went_on"] += went_on
            shutil.rmtree(out.parent)
            shutil.rmtree(root)
    orphans_end(folder)
    return record


def where(root: Path, out: Path) -> str:
    """What a killed run had come to."""
    if stored(out):
        return f"after {stored(out)[-1]}"
    if MEDIAPIPE.installed:
        return "environment installed"
    if list(root.glob(".*.part")):
        packages = any(root.glob("packages/*.whl"))
        return "unpacking packages" if packages else "making the environment, downloading"
    return "nothing yet"


def orphans_end(folder: Path) -> None:
    """Waits until no process has a path in `folder` among its arguments.

    Raises:
        AssertionError: one is still there after a minute.
    """
    start = time.perf_counter()
    while True:
        running = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            with contextlib.suppress(OSError):
                if str(folder) in path.read_bytes().decode(errors="replace"):
                    running.append(path.parent.name)
        if not running:
            return
        assert time.perf_counter() - start < 60, f"processes that outlived their parent: {running}"
        time.sleep(0.02)


def use_local_mediapipe(folder: Path) -> Path:
    """Lets environments be made of one wheel that knows the tiny scene; the video, alone."""
    wheels = folder / "wheels"
    wheels.mkdir()
    known = folder / "known.npz"
    np.savez(known, **landmarks())
    digest = wheel(
        wheels,
        {
            "mediapipe/__init__.py": FAKE.replace("KNOWN", str(known)),
            "cv2.py": FAKE_CV2,
            "mediapipe_look.py": FAKE_LOOK.replace("PEOPLE", "[]"),
            **{f"{name}.py": text for name, text in FAKE_MODEL.items()},
            "numpy.pth": f"{Path(np.__file__).parents[1]}\n",  # the running one
        },
    )
    requirements = folder / "requirements.txt"
    requirements.write_text(f"mediapipe==0 --hash=sha256:{digest}\n")
    os.environ |= {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheels),
                   "HOIGS_CACHE": str(folder / "cache")}  # fmt: skip
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    local: dict[str, Any] = {
        "requirements": requirements,
        "pythons": (version,),
        "files": (),
        "trial": "import numpy, cv2, mediapipe; print('local')",
    }
    for name, value in local.items():
        object.__setattr__(MEDIAPIPE, name, value)  # of a frozen dataclass, in this process alone
    (folder / "alone").mkdir()
    return tiny_video(folder).rename(folder / "alone/tiny.mp4")


def wheel(folder: Path, files: dict[str, str]) -> str:
    """A wheel `mediapipe` 0; its SHA-256."""
    info = "mediapipe-0.dist-info"
    files = files | {
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: mediapipe\nVersion: 0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nTag: py3-none-any\n",
    }
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    path = folder / "mediapipe-0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def table(record: dict[str, Any]) -> str:
    """For docs/design/robustness.md."""
    lines = ["| killed | times |", "| --- | --- |"]
    lines += [f"| {name} | {count} |" for name, count in record["killed_in"].items()]
    lines += [
        "",
        f"`python benchmarks/kill_prepare.py {record['command']}`: {record['kills']} kills in runs "
        f"of {record['unbroken_s']} s; {record['finished']} clips finished, {record['went_on']} of "
        "them by a run that went on where a killed one was; all file by file equal to the unbroken "
        "one. No process, temporary file or held lock was left.",
    ]
    return "\n".join(lines)


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
    from hoigs.preparation.report.overlay import VideoWriter

    path = folder / "tiny.mp4"
    with VideoWriter(path, fps=12, crf=8) as video:
        for i in range(FRAMES):
            video.add(picture(i))
    return path


if __name__ == "__main__":
    main()
