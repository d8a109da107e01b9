"""Fifteen things that people ask of such a program: the command that answers each, run here.

    python benchmarks/wants.py --video juggle.mp4 --readers readers/bin/python --out FOLDER
    python benchmarks/wants.py … --only ply mhr          # some of them

Each row runs its commands as a user types them, on a built-in clip or on the video, and says what
came out, by a program that is not hoigs where there is one (`read_back.py`, in an environment of
its own; ffprobe; Chromium). A row whose command fails is "failed" with its last line. Results go to
FOLDER/wants.json and, as a table, to the terminal.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
TINY = "builtin:lift-and-swing?width=96&frames=24"
SMALL = ("--set", "train.steps=60", "--set", "train.width=160")


@dataclass
class Shop:
    """Where the commands run, and what they have cost.

    Attributes:
        folder: they are run in it. readers: a Python without hoigs. typed: commands of this row.
        seconds: that they took.
    """

    folder: Path
    readers: str
    typed: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def hoigs(self, *words: str) -> str:
        """Runs `hoigs WORDS`, and gives what it prints.

        Raises:
            RuntimeError: it failed; the message is its last line.
        """
        if "--out" in words and "--overwrite" not in words:  # of an earlier run of this script
            made = self.folder / words[words.index("--out") + 1]
            shutil.rmtree(made, ignore_errors=True)
            for file in (made, made.with_name(f"{made.name}.json")):
                file.unlink(missing_ok=True)
        quoted = (f"'{word}'" if "?" in word else word for word in words)
        self.typed.append(f"hoigs {' '.join(quoted)}")
        return self._run([sys.executable, "-m", "hoigs", *words])

    def python(self, script: Path, *words: str, outside: bool = False) -> str:
        """Runs a script of the repository; `outside`: in the environment of the readers."""
        self.typed.append(f"python {script.relative_to(ROOT)} {' '.join(words)}".strip())
        return self._run([self.readers if outside else sys.executable, str(script), *words])

    def read(self, *files: str) -> str:
        """What the readers say of files; not a command of the user's."""
        script = str(ROOT / "benchmarks/read_back.py")
        done = subprocess.run(
            [self.readers, script, *files], cwd=self.folder, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        named = [line for line in done.stdout.splitlines() if ": " in line]  # Blender talks
        return "; ".join(named[-len(files) :])

    def _run(self, words: list[str]) -> str:
        began = time.perf_counter()
        done = subprocess.run(
            words, cwd=self.folder, capture_output=True, text=True, check=False,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        self.seconds += time.perf_counter() - began
        if done.returncode:
            said = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
            raise RuntimeError(said[-1] if said else f"exit code {done.returncode}")
        return done.stdout


def probe(path: Path) -> str:
    found = json.loads(
        subprocess.run(
            ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(path)],
            capture_output=True, text=True, check=True,
        ).stdout
    )["streams"][0]  # fmt: skip
    size = f"{found['width']}x{found['height']}"
    return f"ffprobe: {found['codec_name']}, {size}, {found['nb_read_frames']} frames"


def own_video(shop: Shop) -> str:
    shop.hoigs("prepare", "my.mp4", "--out", "clips/mine", "--max-frames", "16",
               "--width", "320", "--yes")  # fmt: skip
    shop.hoigs("train", "clips/mine", "--out", "runs/mine", *SMALL)
    shop.hoigs("render", "runs/mine", "--out", "mine.mp4", "--compare")
    return probe(shop.folder / "mine.mp4")


def viewer(shop: Shop) -> str:
    """The page in Chromium without a network: is it drawn, and is another time another picture?"""
    from playwright.sync_api import sync_playwright
    from web_file import FLAGS, SEEK

    shop.hoigs("view", "runs/demo", "--html", "demo.html")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_context(viewport={"width": 480, "height": 360}, offline=True).new_page()
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto((shop.folder / "demo.html").as_uri())
        shots = []
        for time_ in (0, 16):
            while not page.evaluate("window.drawn > 0"):
                page.wait_for_timeout(200)
            page.evaluate(f"({SEEK})({time_})")
            page.wait_for_timeout(3000)
            shots.append(page.screenshot())
        browser.close()
    size = (shop.folder / "demo.html").stat().st_size / 1e6
    moved = "another time is another picture" if shots[0] != shots[1] else "NOTHING MOVES"
    return f"Chromium, no network: {size:.1f} MB, {moved}, {len(wrong)} errors"


def per_frame_ply(shop: Shop) -> str:
    shop.hoigs("export", "runs/demo", "-f", "ply-sequence", "--out", "plys")
    files = sorted(str(p) for p in (shop.folder / "plys").rglob("*.ply"))
    return f"{len(files)} files; {shop.read(files[0])}"


def bvh_and_fbx(shop: Shop) -> str:
    shop.hoigs("export", "runs/demo", "-f", "bvh", "--out", "walk.bvh")
    shop.hoigs("export", "runs/demo", "-f", "gltf-body", "--out", "body.glb")
    shop.python(ROOT / "examples/blender_import.py", "body.glb", "--fbx", "body.fbx", outside=True)
    return f"{shop.read('walk.bvh')}; {shop.read('body.fbx')}"


def hands(shop: Shop) -> str:
    shop.hoigs("export", "runs/demo", "-f", "tracks", "--out", "tracks")
    return shop.read("tracks/contacts.csv")


def wrong_cameras(shop: Shop) -> str:
    """The second preparation keeps what does not depend on the lens."""
    shop.hoigs("prepare", "my.mp4", "--out", "clips/mine", "--max-frames", "16",
               "--width", "320", "--focal", "1450", "--overwrite")  # fmt: skip
    focal = np.load(shop.folder / "clips/mine/cameras.npz")["K"][0, 0, 0]
    return f"numpy: focal length {focal:.1f} px (1450 at a quarter of the video's size: 362.5)"


def uncertain(shop: Shop) -> str:
    shop.typed.append("clips/mine/report.html, runs/mine/report.html")
    report = json.loads((shop.folder / "clips/mine/report.json").read_text())
    reasons = ", ".join(report["unknown"])
    return f"report.json: supposed, each with its reason: {reasons}"


def same_numbers(shop: Shop) -> str:
    sums = []
    for out in ("runs/one", "runs/two"):
        shop.hoigs("train", TINY, "--out", out, "--set", "train.steps=20")
        files = sorted((shop.folder / out / "checkpoints").rglob("*"))
        content = b"".join(p.read_bytes() for p in files if p.suffix == ".safetensors")
        sums.append((hashlib.sha256(content).hexdigest()[:12],
                     _scores(shop.folder / out / "evaluation.json")))  # fmt: skip
    same = "equal" if sums[0] == sums[1] else "DIFFERENT"
    return f"sha256 of both models {sums[0][0]}, {sums[1][0]}; files and scores {same}"


def _scores(path: Path) -> str:
    content = json.loads(path.read_text())
    return json.dumps(content.get("views", content.get("scores", content)), sort_keys=True)


def long_video(shop: Shop) -> str:
    shop.hoigs("train", "builtin:lift-and-swing?width=96&frames=96", "--out", "runs/long",
               "--chunk", "16", "--set", "train.steps=60", "--no-eval")  # fmt: skip
    shop.hoigs("export", "runs/long", "-f", "bvh", "--out", "long.bvh")
    return shop.read("long.bvh")


def several_people(shop: Shop) -> str:
    """Two men who cross, made of the recorded one (`people.py`)."""
    from people import SHARED, crossing

    video = shop.folder / "two.mp4"
    if not video.exists():
        crossing(SHARED / "data" / "juggle", video)
    shop.hoigs("prepare", "two.mp4", "--out", "clips/two", "--person", "anna=260,380", "--person",
               "ben=1020,380", "--object", "none", "--max-frames", "16", "--width", "320",
               "--yes")  # fmt: skip
    found = []
    for name in ("anna", "ben"):
        with np.load(shop.folder / f"clips/two/bodies/{name}.npz") as body:
            way = body["transl"][-1, 0] - body["transl"][0, 0]
            found.append(f"{name} goes {way:+.2f} m")
    return f"numpy: {', '.join(found)} along x"


def object_shape(shop: Shop) -> str:
    """The box of the demo has 0.34 x 0.25 x 0.26 m: 22.1 litres."""
    shop.hoigs("export", "runs/demo", "-f", "gltf-body", "--entities", "object", "--out", "box.glb")
    shop.hoigs("export", "runs/demo", "-f", "tracks", "--out", "poses")
    return f"{shop.read('box.glb')}; {shop.read('poses/objects.csv')}"


def sam_3d_body(shop: Shop) -> str:
    """The true body of a built-in clip, in SAM 3D Body's file; joints off the truth."""
    from estimates.bodies import write_bodies
    from estimates.figures import body_figures
    from estimates.source import write_source

    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.readers.clip import ClipFolderReader
    from hoigs.synthesis.named import named_clip

    body, source = AnnyBody(), shop.folder / "filmed"
    truth = ClipFolderReader().read(named_clip(TINY, body))
    shutil.rmtree(source, ignore_errors=True)
    write_source(truth, body, source, (0.0, 0.0), 0, cameras=True)
    (source / "pose_mediapipe.npz").unlink()
    write_bodies(truth, body, "sam-3d-body", source)
    shop.hoigs("prepare", "filmed", "--out", "clips/mhr", "--object", "none", "--set",
               f"folder_fps={truth.fps}", "--yes")  # fmt: skip
    made = ClipFolderReader().read(shop.folder / "clips/mhr")
    figures = body_figures(made, truth, body, (np.eye(3), np.zeros(3)))
    return f"joints about the pelvis {figures['root_aligned_joints_mm']} mm off the truth (mean)"


def licences(shop: Shop) -> str:
    lines = shop.python(ROOT / "scripts/licences.py").strip().splitlines()
    return f"{len(lines)} packages, all of them allowed by their own words"


def many_scenes(shop: Shop) -> str:
    rows = [f'{{name: {name}, clip: "builtin:{name}?width=64&frames=12"}}'
            for name in ("carry", "glide", "throw-and-catch")]  # fmt: skip
    manifest = "rows: [" + ", ".join(rows) + "]\n"
    (shop.folder / "rows.yaml").write_text(manifest)
    shop.hoigs("batch", "rows.yaml", "--out", "batch", "--set", "train.steps=20")
    summary = json.loads((shop.folder / "batch/summary.json").read_text())
    rows_ = summary["rows"] if isinstance(summary, dict) else summary
    states = [str(row.get("state", row)) for row in rows_]
    plys = len(list((shop.folder / "batch").rglob("*.ply")))
    return f"summary.json: {len(rows_)} rows, {', '.join(sorted(set(states)))}; {plys} .ply"


def install(shop: Shop) -> str:
    rows = json.loads(shop.hoigs("doctor", "--json"))
    bad = [row["what"] for row in rows if not row["ok"]]
    return f"{len(rows)} checks, {len(bad)} of them not passed{': ' if bad else ''}{', '.join(bad)}"


WANTS: dict[str, tuple[str, Callable[[Shop], str]]] = {
    "video": ("a video of mine reconstructed", own_video),
    "viewer": ("to see it from any side, at any time", viewer),
    "ply": ("a PLY of every frame", per_frame_ply),
    "skeleton": ("the motion as BVH and FBX", bvh_and_fbx),
    "hands": ("what the hands do", hands),
    "cameras": ("other cameras than it found", wrong_cameras),
    "blur": ("to know what is uncertain, and why", uncertain),
    "numbers": ("the same numbers again", same_numbers),
    "long": ("a long video", long_video),
    "people": ("several people", several_people),
    "object": ("the object's shape and poses", object_shape),
    "mhr": ("a body by SAM 3D Body (MHR)", sam_3d_body),
    "licence": ("to use it in a product", licences),
    "scenes": ("many scenes", many_scenes),
    "install": ("to know what is installed", install),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--video", type=Path, required=True, help="a person who handles a thing")
    parser.add_argument("--readers", required=True, help="Python of read_back.py's packages")
    parser.add_argument("--out", type=Path, required=True, help="folder, new or of an earlier run")
    parser.add_argument("--only", nargs="*", choices=WANTS, help="default: all")
    options = parser.parse_args()
    folder = options.out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "wants.json"
    rows: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    readers = str(Path(options.readers).absolute())
    shop = Shop(folder, readers)
    shutil.copyfile(options.video, folder / "my.mp4")  # alone: no masks or tracks beside it
    if not (folder / "runs/demo/evaluation.json").exists():
        shop.hoigs("demo", "--fast", "--out", "runs/demo")
    for name in options.only or WANTS:
        want, answer = WANTS[name]
        shop.typed, shop.seconds = [], 0.0
        try:
            said = answer(shop)
        except (RuntimeError, OSError, subprocess.SubprocessError) as error:
            said = f"failed: {error}"
        rows[name] = {
            "want": want, "typed": shop.typed, "seconds": round(shop.seconds), "said": said,
            "date": time.strftime("%Y-%m-%d"),
        }  # fmt: skip
        kept.write_text(json.dumps({k: rows[k] for k in WANTS if k in rows}, indent=1) + "\n")
        print(json.dumps(rows[name]), flush=True)
    for name, row in rows.items():
        typed = "<br>".join(f"`{line}`" for line in row["typed"])
        print(f"| {WANTS[name][0]} | {typed} | {row['said']} |")
    return sum(row["said"].startswith("failed") for row in rows.values())


if __name__ == "__main__":
    sys.exit(main())
