"""How large, how exact and how fast a run is as one file for the web.

    python benchmarks/web_file.py RUN [--out benchmarks/results/web-file.json]

Sizes: `gltf-4d`, `view --html`, and a PLY and a SOG sequence of the same moments (the mean of
SAMPLES moments times their number). PSNR: the page in headless Chromium, network off, against the
run's own rasterizer from the video's camera, at frames and between them. Rate: the page plays for
--seconds in that Chromium, whose WebGL2 is SwiftShader's, on the processor; "script" is what is
left of the work of a frame where a GPU draws: joints, sorting, uploads.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import os
import shutil
import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

import hoigs
from hoigs.core.values.between import camera_between
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.run_folder import versions
from hoigs.viewing.viewer.panes import fitted
from hoigs.viewing.viewer.run_drawing import Look, RunDrawing

SAMPLES = 4
FLAGS = [
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
]  # fmt: skip
SEEK = "f => { const t = document.getElementById('time'); t.value = f; t.oninput({target: t}); }"


def sizes(run: Path, frames: int, folder: Path) -> dict[str, float]:
    """Megabytes of each form."""
    file = folder / "run.glb"
    hoigs.export(run, format="gltf-4d", out=file)
    hoigs.view(run, html=folder / "run.html")
    found = {
        "gltf-4d": file.stat().st_size,
        "gltf-4d, gzip": len(gzip.compress(file.read_bytes(), 9)),
        "view --html": (folder / "run.html").stat().st_size,
    }
    for name in ("ply", "sog"):
        every = []
        for i in np.linspace(0, frames - 1, SAMPLES).round().astype(int).tolist():
            out = folder / f"{i}.{name}"
            chosen = ("pad_sh=false",) if name == "ply" else ()
            hoigs.export(run, format=name, out=out, start=i, overrides=chosen)
            every.append(out.stat().st_size)
        found[f"{name} sequence"] = frames * sum(every) / len(every)
    return {name: round(size / 1e6, 2) for name, size in found.items()}


def played(run: Path, page: Path, side: int, seconds: float) -> dict[str, Any]:
    """PSNR by frame, and how fast it plays."""
    loaded = LoadedRun.open(run, pixels=False)
    drawing = RunDrawing(loaded)
    look, last = Look(entities=frozenset(drawing.names)), loaded.clip.num_frames - 1
    binary = os.environ.get("HOIGS_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=binary, args=FLAGS)
        own = loaded.clip.cameras[0]
        high = round(side * own.height / own.width)
        view = {"width": side, "height": high}
        tab = browser.new_context(viewport=view, offline=True).new_page()
        tab.goto(page.as_uri())
        tab.add_style_tag(content="#top, #bar, #about { display: none !important; }")

        def wait(count: int) -> None:
            while (tab.evaluate("window.drawn") or 0) <= count:
                tab.wait_for_timeout(50)

        wait(0)
        scores = {}
        for frame in (0.0, last // 4, last // 2, 3 * last // 4 + 0.5, last):
            drawn = tab.evaluate("window.drawn")
            tab.evaluate(SEEK, frame)
            wait(drawn)
            shot = np.asarray(Image.open(BytesIO(tab.screenshot())).convert("RGB")).astype(float)
            camera = fitted(camera_between(loaded.clip, frame), (side, high))
            error = ((shot - drawing.draw(frame, camera, look).image.astype(float)) ** 2).mean()
            scores[str(frame)] = round(10 * math.log10(255**2 / error), 2)
        tab.evaluate("document.getElementById('play').click()")
        tab.wait_for_timeout(1000)
        began = tab.evaluate("[performance.now(), window.drawn, window.spent]")
        tab.wait_for_timeout(1000 * seconds)
        ended = tab.evaluate("[performance.now(), window.drawn, window.spent]")
        browser.close()
    passed, drawn, spent = (b - a for a, b in zip(began, ended, strict=True))
    return {
        "psnr_db": scores,
        "pictures_a_second_software": round(1000 * drawn / passed, 2),
        "script_ms_a_picture": round(spent / max(drawn, 1), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/web-file.json"))
    parser.add_argument("--side", type=int, default=512, help="pixels of the page")
    parser.add_argument("--seconds", type=float, default=10.0)
    given = parser.parse_args()
    loaded = LoadedRun.open(given.run, pixels=False)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        found: dict[str, Any] = {
            **versions(),
            "run": f"{loaded.spec.name} on {loaded.clip.name}, step {loaded.step}",
            "gaussians": loaded.model.count(),
            "frames": loaded.clip.num_frames,
            "megabytes": sizes(given.run, loaded.clip.num_frames, folder),
        }
        found |= played(given.run, folder / "run.html", given.side, given.seconds)
    given.out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print("| file | MB |\n|---|---|")
    for name, size in found["megabytes"].items():
        print(f"| {name} | {size} |")
    print({k: v for k, v in found.items() if k not in ("megabytes", "gaussians")})


if __name__ == "__main__":
    main()
