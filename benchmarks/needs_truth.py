"""Does `hoigs study needs` find what clips of known truth need? Right or wrong, by case and seed.

    python benchmarks/needs_truth.py --jobs 60 --threads 1 --minutes 20
    python benchmarks/needs_truth.py --only still glide --seeds 2 --jobs 2

A seed is used for the clip (textures, points, jolts) and for the training. Only the search spaces
that a case names are searched, with the budget of a full search; --all searches all of them. A JSON
is written for each case and seed as soon as it is done, and the same command continues after an
interruption; --summary only reads the files. --blur SIGMA makes the renderer worse, by a blur of so
many pixels of what it draws (gradients pass through it): the answers should stay as they are.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from many_cells import read_cell, run_cells, write_cell

RIGID_FEW = ("rigid, 2 knots", "rigid, 3 knots")
RIGID_MANY = ("rigid, adaptive knots",)
BEYOND = ("articulated", "rigid and residual", "per Gaussian")


@dataclass(frozen=True)
class Case:
    """A clip, and the candidates that are right for it, by search space.

    Attributes:
        clip_settings: of the clip, beside those that all have.
        every: the object's pose is known in every so many frames, and interpolated between them.
    """

    clip: str
    right: dict[str, tuple[str, ...]]
    clip_settings: str = ""
    every: int = 1


CASES = {
    "still": Case("still-box", {"object": ("static",), "interaction": ("off",)}),
    "glide": Case("glide", {"object": RIGID_FEW}),
    "eight": Case("figure-eight", {"object": RIGID_MANY}),
    "throw": Case("throw-and-catch", {"object": RIGID_MANY}),
    "bend": Case("bending-bar", {"object": BEYOND}),
    "hinge": Case("hinged-bar", {"object": BEYOND}),
    "soft": Case("soft-ball", {"object": BEYOND}),
    "mirror": Case("mirror-box", {"object": RIGID_MANY}),
    "alone": Case("moving-alone", {"object": RIGID_FEW, "interaction": ("off",)}),
    # Jolts of two pixels, over a sweep that leaves the arms room for them. A track that knows every
    # frame has them; one that knows every eighth does not, and they have to come from the hands.
    "push": Case(
        "jolted-push",
        {"interaction": ("object only", "both")},
        "&object.jolt_metres=0.06&object.swing_degrees=20",
        every=8,
    ),
}


def search_of(case: Case, seed: int, options: argparse.Namespace, kind: type[Any]) -> Any:
    """A search of class `kind`, with the search spaces that the case names."""
    from hoigs.runs.clip_source import read_clip
    from hoigs.studies.needs.result import Settings
    from hoigs.studies.needs.search_space import load_search_spaces

    clip = read_clip(
        f"builtin:{case.clip}?frames={options.frames}&fps={options.frames / 4}"
        f"&width={options.size}&samples=4&edge_samples=4&held_out_views=0"
        f"&test_frames={options.frames // 8}&scene_points=1000&object_points=600&seed={seed}"
        f"{case.clip_settings}"
    )
    if case.every > 1:
        clip = with_sparse_tracks(clip, case.every)
    wanted = {"object", *case.right}  # which `unless` of the others names
    spaces = [s for s in load_search_spaces() if options.all or s.name in wanted]
    given = (f"train.steps={options.steps}", f"train.seed={seed}",
             "model.human.points=2000", "model.human.deformation.resolution=32")  # fmt: skip
    return kind(clip, "hoigs", spaces, given, Settings(share=options.share))


def with_sparse_tracks(clip: Any, every: int) -> Any:
    """The clip, with each object's pose known in every `every`-th frame."""
    import torch
    from interaction import interpolated

    tracks = {}
    for name, track in clip.objects.items():
        given = {k: getattr(track, k).numpy() for k in ("rotations", "translations", "observed")}
        found = {k: torch.as_tensor(v) for k, v in interpolated(given, every).items()}
        tracks[name] = replace(track, **found)
    return replace(clip, objects=tracks)


def run(case: Case, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """One search; what was chosen, whether that is right, and what it cost."""
    from hoigs.studies.needs.report import as_data
    from hoigs.studies.needs.result import summary_line
    from hoigs.studies.needs.search import Search

    began = time.process_time()
    if options.blur:
        blur_renders(options.blur)
    needs = search_of(case, seed, options, Search).run()
    chosen = {a.space.name: a.chosen.name for a in needs.answers if a.chosen is not None}
    return {
        "chosen": chosen,
        "right": all(chosen[name] in candidates for name, candidates in case.right.items()),
        "because": [summary_line(answer) for answer in needs.answers],
        "cpu_seconds": round(time.process_time() - began, 1),
        "seconds": round(needs.seconds, 1),
        "full_seconds": round(needs.full_seconds, 1),
        "search_over_full": round(needs.seconds / needs.full_seconds, 3),
        "needs": as_data(needs),
    }


def blur_renders(sigma: float) -> None:
    """From now on in this process, what the Warp rasterizer draws is blurred."""
    from kornia.filters import gaussian_blur2d

    from hoigs.rasterizers.warp.rasterizer import WarpRasterizer

    sharp = WarpRasterizer.render

    def render(self: Any, *given: Any, **named: Any) -> Any:
        drawn = sharp(self, *given, **named)
        color = drawn.color.permute(2, 0, 1)[None]
        blurred = gaussian_blur2d(color, (7, 7), (sigma, sigma), border_type="replicate")
        return replace(drawn, color=blurred[0].permute(1, 2, 0))

    WarpRasterizer.render = render  # type: ignore[method-assign]


def settings_of(options: argparse.Namespace) -> dict[str, Any]:
    """What a cell's result depends on."""
    names = ("steps", "frames", "size", "share", "blur", "all")
    return {name: getattr(options, name) for name in names}


def cells_of(options: argparse.Namespace) -> list[str]:
    """Seed by seed, so that an interrupted run has results of every case."""
    return [f"{name}-{seed}" for seed in range(options.seeds) for name in options.only]


def summary(options: argparse.Namespace) -> bool:
    """Print and write the table; whether every case is right in 9 of 10 seeds."""
    rows, good = [], True
    for name in options.only:
        cells = [
            read_cell(options.out, f"{name}-{seed}", settings_of(options))
            for seed in range(options.seeds)
        ]
        done = [cell for cell in cells if cell is not None]
        right = sum(bool(cell["right"]) for cell in done)
        good &= len(done) == options.seeds and right >= 0.9 * options.seeds
        rows.append(
            {
                "case": name,
                "right": right,
                "of": len(done),
                "seeds": options.seeds,
                "chosen": [cell["chosen"] for cell in done],
                "object_psnr": _median([_object_psnr(cell) for cell in done]),
                "median_cpu_seconds": _median([cell["cpu_seconds"] for cell in done]),
                "median_search_over_full": _median([cell["search_over_full"] for cell in done]),
            }
        )
    print("| case | right | CPU s a search | search / full training | with the final training |")
    print("|---|---|---:|---:|---:|")
    for row in rows:
        ratio = row["median_search_over_full"]
        shown = ("–", "–") if ratio is None else (f"{ratio:.2f}", f"<= {1 + ratio:.2f}")
        print(
            f"| {row['case']} | in {row['right']} of {row['of']} seeds | "
            f"{row['median_cpu_seconds'] or '–'} | {shown[0]} | {shown[1]} |"
        )
    path = options.out / "summary.json"
    path.write_text(json.dumps({"settings": settings_of(options), "rows": rows}, indent=1))
    print(f"wrote {path}")
    return good


def _object_psnr(cell: dict[str, Any]) -> float:
    """Of the best of the object's candidates, on the frames held back, dB."""
    answer = next(a for a in cell["needs"]["answers"] if a["search_space"] == "object")
    return max(statistics.mean(c["score"]["psnr"]) for c in answer["candidates"] if c["score"])


def _median(values: list[float]) -> float | None:
    return round(statistics.median(values), 2) if values else None


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=1200, help="of a full training")
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--share", type=float, default=0.15, help="of training frames, held back")
    parser.add_argument("--blur", type=float, default=0.0, help="sigma in pixels; 0: none")
    parser.add_argument("--all", action="store_true", help="search every search space")
    parser.add_argument("--jobs", type=int, default=1, help="searches at a time")
    parser.add_argument("--threads", type=int, default=1, help="of each")
    parser.add_argument("--minutes", type=float, help="stop then; the same command goes on")
    parser.add_argument("--out", type=Path, default=Path("runs/needs-truth"))
    parser.add_argument("--summary", action="store_true", help="only read what is done")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> int:
    options = parse()
    if options.cell is not None:
        name, _, seed = options.cell.rpartition("-")
        found = run(CASES[name], int(seed), options)
        write_cell(options.out, options.cell, settings_of(options), found)
        print(f"{'right' if found['right'] else 'WRONG'} {found['chosen']}")
        print("\n".join(found["because"]))
        return 0
    if not options.summary:
        own = [f"--{key}={value}" for key, value in settings_of(options).items() if key != "all"]
        run_cells(
            cells_of(options), options.out, settings_of(options),
            [*own, *(["--all"] if options.all else []), "--out", str(options.out)],
            jobs=options.jobs, threads=options.threads, minutes=options.minutes,
        )  # fmt: skip
    return 0 if summary(options) else 1


if __name__ == "__main__":
    sys.exit(main())
