"""The paper's tables: their rows as specs in matched settings, and the numbers that it prints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

import yaml

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.evaluation.geometry import GEOMETRY
from hoigs.evaluation.scores import DIGITS, TITLES
from hoigs.studies.compare.data import Axis, Point
from hoigs.studies.jobs.results import Row, Spread

UNSHIPPED = "hoigs ships no {}; prepare a clip with them and name it as a CLIP"


def _source(label: str, key: str, what: str) -> Row:
    return Row(label, None, paper=(f"priors/{key}",), why=UNSHIPPED.format(what))


def _method(name: str, *paper: str) -> Row:
    return Row(name, f"{name}@matched", paper=paper)


TABLES: dict[str, tuple[Row, ...]] = {
    "comparison": (
        _method("hoigs", "runtime/hoigs", "hosnerf/hoigs", "behave/hoigs", "arctic/hoigs",
                "arctic-geometry/hoigs"),
        _method("hoigs-paper"),
        _method("4dgs", "runtime/4dgs", "hosnerf/4dgs", "behave/4dgs", "arctic/4dgs"),
        _method("d3dgs", "runtime/d3dgs", "hosnerf/d3dgs"),
        _method("e-d3dgs", "runtime/e-d3dgs", "hosnerf/e-d3dgs", "behave/e-d3dgs",
                "arctic/e-d3dgs"),
        _method("ex4dgs", "runtime/ex4dgs", "hosnerf/ex4dgs"),
        _method("exavatar", "hosnerf/exavatar", "behave/exavatar"),
        _method("hugs"),
        _method("static-3dgs"),
        _method("k-planes-gs", "hosnerf/k-planes"),
        _method("nerfies-gs", "hosnerf/nerfies"),
        _method("hypernerf-gs", "hosnerf/hypernerf"),
        _method("d2nerf-gs", "hosnerf/d2nerf"),
        _method("neuman-gs", "hosnerf/neuman"),
        _method("hosnerf-gs", "hosnerf/hosnerf"),
        _method("hold-gs", "arctic/hold", "arctic-geometry/hold"),
    ),
    "ablation-object-motion": (
        # the paper's has no track, which would give it the true pose of every frame
        Row("MLP", "hoigs-object-mlp@matched", ("model.object.deformation.track=false",),
            paper=("object-motion/mlp",)),
        Row("MLP about the track's poses", "hoigs-object-mlp@matched"),
        Row("CHS that starts near the track", "hoigs@matched",
            ("model.object.deformation.use=deformation:chs",),
            paper=("object-motion/hoigs",)),
        Row("CHS about the track, tangents by finite differences", "hoigs-chs-fd@matched",
            paper=("object-motion/baseline-deformation",)),
        Row("CHS about the track (hoigs)", "hoigs@matched"),
    ),
    "ablation-interaction": (
        Row("off", "hoigs-no-interaction@matched", paper=("interaction/no-interaction",)),
        Row("on (hoigs)", "hoigs@matched", paper=("interaction/hoigs",)),
    ),
    "ablation-human-feature": (
        Row("embedding", "hoigs-human-embedding@matched",
            paper=("interaction/no-human-feature",)),
        Row("HexPlane (hoigs)", "hoigs@matched", paper=("interaction/hoigs",)),
    ),
    "object-prior": (
        Row("the clip's own points", "hoigs@matched"),
        Row("masked depth", "hoigs@matched",
            ("model.object.initializer.use=initializer:depth",),
            paper=("object-prior/depth",)),
        Row("MASt3R", None, paper=("object-prior/mast3r",),
            why="hoigs ships no MASt3R; give its points with --specs, initializer:points"),
        Row("diffusion (score distillation)", None, paper=("object-prior/diffusion",),
            why="hoigs ships no diffusion weights; give yours: --specs, initializer:sds"),
    ),
    "mask-depth-source": (
        Row("the clip's own", "hoigs@matched"),
        Row("a third of the masks' borders wrong", "hoigs@matched",
            clip_settings="noise.mask_boundary=0.33"),
        Row("depth with 5 % noise and 10 % holes", "hoigs@matched",
            clip_settings="noise.depth_relative=0.05&noise.depth_holes=0.1"),
        _source("Samurai + Metric3D v2", "samurai+metric3dv2", "Samurai, no Metric3D"),
        _source("Samurai + Video Depth Anything", "samurai+vda",
                "Samurai, no Video Depth Anything"),
        _source("Samurai + DepthCrafter", "samurai+depthcrafter",
                "Samurai, no DepthCrafter"),
        _source("Track Anything + Metric3D v2", "trackanything+metric3dv2",
                "Track Anything, no Metric3D"),
        _source("SAM 2 + Video Depth Anything", "sam2+vda",
                "SAM 2, no Video Depth Anything"),
        _source("Mask R-CNN + Metric3D v2", "maskrcnn+metric3dv2",
                "Mask R-CNN, no Metric3D"),
    ),
}  # fmt: skip


def choose_tables(names: Sequence[str]) -> dict[str, tuple[Row, ...]]:
    """The rows of the named tables; "all" names every table.

    Raises:
        HoigsError: there is no such table.
    """
    for name in names:
        if name not in (*TABLES, "all"):
            raise HoigsError(
                f"no table {name!r}{did_you_mean(name, TABLES)}; there are {', '.join(TABLES)} "
                "and all"
            )
    return TABLES if "all" in names else {name: TABLES[name] for name in names}


# Numbers that the paper prints, from paper.yaml.

PAPER_METRICS = ("psnr", "lpips", "cd_best")


@dataclass(frozen=True)
class Published:
    """One row of one of the paper's tables.

    Attributes:
        source: its table. data: what it was measured on. scenes: how many.
        means: of the rows that the paper gives, by metric. printed: its own averages; where the
            two disagree, the paper contradicts itself.
    """

    source: str
    data: str
    row: str
    scenes: int
    means: dict[str, float]
    printed: dict[str, float]

    def value(self, metric: str) -> float | None:
        """The mean of the scenes where they are given, else what is printed."""
        return self.means.get(metric, self.printed.get(metric))


@cache
def _tables() -> dict[str, Any]:
    return yaml.safe_load(Path(__file__).with_name("paper.yaml").read_text())


def published(reference: str) -> Published:
    """The row "TABLE/ROW" of paper.yaml.

    Raises:
        KeyError: there is none.
    """
    table, _, row = reference.partition("/")
    known = [f"{name}/{r}" for name, content in _tables().items() for r in content["rows"]]
    if reference not in known:
        raise KeyError(f"{reference!r} is not in paper.yaml{did_you_mean(reference, known)}")
    content = _tables()[table]
    numbers = content["rows"][row]
    means = {m: mean(numbers[m]) for m in PAPER_METRICS if m in numbers}
    scenes = len(content.get("scenes", ()))
    return Published(
        content["source"], content["data"], row, scenes, means, numbers.get("printed", {})
    )


REGIONS = ("full", "human_object", "human", "object", "interaction")
PAPER = {"psnr": "PSNR dB ↑", "lpips": "LPIPS ↓", "cd_best": "CD_best m² ↓", "fps": "frames/s ↑"}
ELSEWHERE = (
    "Published by the paper, **on other data** and by its own protocol; not to be compared number "
    "by number with the tables above."
)


def columns(points: Sequence[Point]) -> Iterator[tuple[str, list[Axis]]]:
    """Title and columns of each table in the paper's form of which some point has a number."""
    found = []
    for view in ("test frames", "held-out cameras"):
        for metric in ("psnr", "ssim", "lpips"):
            axes = [
                Axis(f"{view}/{r}/{metric}", r.replace("_", " + "), "higher", DIGITS[metric])
                for r in REGIONS
            ]
            found.append((f"{TITLES[metric]}, {view}", axes))
    names = [n for n in GEOMETRY if not n.endswith(("accuracy", "completeness"))]
    digits = {"cd_best": 4}
    axes = [Axis(f"geometry//{n}", GEOMETRY[n], "lower", digits.get(n, 2)) for n in names]
    for title, own in (*found, ("Geometry", axes)):
        if any(isinstance(p.values.get(a.name), Spread) for p in points for a in own):
            yield title, own


def published_table(table: str) -> list[str]:
    """The paper's numbers for the rows of a table; Markdown lines, none where it has none."""
    found = [(row.label, published(name)) for row in TABLES[table] for name in row.paper]
    if not found:
        return []
    lines = [ELSEWHERE, "", f"| | where | {' | '.join(PAPER.values())} |", "|---" * 6 + "|"]
    for label, own in found:
        cells = " | ".join(_published(own, metric) for metric in PAPER)
        lines.append(f"| {label} | {own.source}, {own.data} | {cells} |")
    return [*lines, ""]


def _published(found: Published, metric: str) -> str:
    """The mean of the printed scenes; with the printed average where that is another number."""
    value, printed = found.value(metric), found.printed.get(metric)
    if value is None:
        return ""
    digits = {"lpips": 3, "cd_best": 4}.get(metric, 2)
    text = f"{value:.{digits}f}"
    differs = printed is not None and abs(printed - value) > 0.6 * 10**-digits
    return f"{text} (printed: {printed:.{digits}f})" if differs else text
