"""Evaluation: scores by view, region and metric, times and sizes, as tables and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hoigs.core.errors import did_you_mean
from hoigs.core.system.files import write_whole
from hoigs.core.values.clip import Clip
from hoigs.core.values.shown import html_table
from hoigs.evaluation.geometry import GEOMETRY
from hoigs.evaluation.geometry import NOTES as GEOMETRY_NOTES
from hoigs.evaluation.protocol import NotComputed, Protocol, Value, mean_of, to_json
from hoigs.metrics.regions import REGIONS

METRICS = ("psnr", "ssim", "lpips", "depth")
TITLES = {"psnr": "PSNR dB ↑", "ssim": "SSIM ↑", "lpips": "LPIPS ↓", "depth": "depth error m ↓"}
DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4, "depth": 4}


@dataclass(frozen=True)
class Table:
    """A table of texts, for printing and for HTML."""

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    notes: Sequence[str]


@dataclass(frozen=True)
class FrameScores:
    """One frame: values by region, then by metric.

    Attributes:
        position: in the scored clip. index: frame number in the video.
    """

    position: int
    index: int
    values: Mapping[str, Mapping[str, Value]]


@dataclass(frozen=True)
class ViewScores:
    """All scored frames of one kind of view, under one protocol.

    Attributes:
        name: "test frames" or "held-out cameras".
    """

    name: str
    protocol: Protocol
    frames: list[FrameScores]

    def mean(self, region: str, metric: str) -> tuple[Value, int]:
        """Mean over the frames that have this score, and their number."""
        if not self.frames:
            return NotComputed(f"the clip has no {self.protocol.split} frames"), 0
        return mean_of([frame.values[region][metric] for frame in self.frames])


@dataclass(frozen=True)
class Timing:
    """Medians over synchronised frames after a warm-up, milliseconds.

    Attributes:
        frames, warmup: numbers of frames that were timed, and drawn before that.
        deform_ms: features, interaction and deformation. raster_ms: rasterization.
        total_ms: of a whole frame. drawn: number of Gaussians with a footprint on the screen.
    """

    frames: int
    warmup: int
    deform_ms: float
    raster_ms: float
    total_ms: float
    drawn: int
    width: int
    height: int
    device: str
    rasterizer: str
    note: str = "what does not depend on time may be cached"

    @property
    def fps(self) -> float:
        return 1000.0 / self.total_ms


@dataclass(frozen=True)
class PartSize:
    """Size of an entity, interaction or decoder; megabytes are 10^6 bytes of its tensors."""

    name: str
    kind: str
    gaussians: int
    parameters: int
    megabytes: float


@dataclass(frozen=True)
class Evaluation:
    """All scores of a model on a clip.

    Attributes:
        geometry: the measures of `geometry.GEOMETRY` on the scored frames.
        scored: the clip with the protocol's poses and cameras; not saved.
    """

    clip: str
    views: list[ViewScores]
    timing: Timing | NotComputed
    sizes: list[PartSize]
    created: str
    geometry: Mapping[str, Value] = field(default_factory=dict)
    scored: Clip | None = field(default=None, repr=False, compare=False)

    def view(self, name: str) -> ViewScores:
        known = {view.name: view for view in self.views}
        if name not in known:
            raise KeyError(f"no view {name!r} among {list(known)}{did_you_mean(name, known)}")
        return known[name]

    def score(self, region: str, metric: str, view: str = "test frames") -> Value:
        """The mean of one metric: `evaluation.score("human_object", "psnr")`."""
        for value, valid in ((region, REGIONS), (metric, METRICS)):
            if value not in valid:
                raise KeyError(f"{value!r} is none of {valid}{did_you_mean(value, valid)}")
        return self.view(view).mean(region, metric)[0]

    def tables(self) -> list[Table]:
        """One table per view, then geometry, render time and size."""
        tables = [score_table(view) for view in self.views]
        if self.geometry:
            tables.append(geometry_table(self.geometry))
        return [*tables, timing_table(self.timing), size_table(self.sizes)]

    def _repr_html_(self) -> str:
        return "".join(html_table(t.title, t.columns, t.rows, t.notes) for t in self.tables())

    def to_dict(self) -> dict[str, Any]:
        """JSON values: every score with its protocol, and the reason of each that is absent."""
        scores, frames = [], []
        for view in self.views:
            for region in REGIONS:
                for metric in METRICS:
                    value, counted = view.mean(region, metric)
                    protocol = view.protocol.of(region).to_dict()
                    scores.append({
                        "view": view.name, "region": region, "metric": metric,
                        "value": _plain(value), "frames": counted, "protocol": protocol,
                    })  # fmt: skip
            for frame in view.frames:
                values = {
                    region: {metric: _plain(v) for metric, v in of_region.items()}
                    for region, of_region in frame.values.items()
                }
                record = {"position": frame.position, "index": frame.index, "values": values}
                frames.append({"view": view.name, **record})
        timing = self.timing
        return {
            "format": "hoigs-evaluation",
            "version": 1,
            "clip": self.clip,
            "created": self.created,
            "scores": scores,
            "geometry": {name: _plain(value) for name, value in self.geometry.items()},
            "timing": _plain(timing) if isinstance(timing, NotComputed) else asdict(timing),
            "size": [asdict(part) for part in self.sizes],
            "frames": frames,
        }

    def save(self, path: Path | str) -> None:
        """Write JSON under a temporary name, then rename."""
        write_whole(Path(path), json.dumps(self.to_dict(), indent=1, allow_nan=False))


def score_table(view: ViewScores) -> Table:
    """A row per region, a column per metric; notes explain metrics that no region has."""
    if not view.frames:
        return Table(view.name, ("region", "frames"), [], [str(view.mean("full", "psnr")[0])])
    rows, notes = [], {}
    shown = [m for m in METRICS if any(view.mean(r, m)[1] for r in REGIONS)]
    for metric in METRICS:
        if metric not in shown:
            notes[metric] = f"{metric}: {view.mean('full', metric)[0]}"
    for region in REGIONS:
        cells = []
        for metric in shown:
            value, _ = view.mean(region, metric)
            cells.append("–" if isinstance(value, NotComputed) else f"{value:.{DIGITS[metric]}f}")
            if isinstance(value, NotComputed):
                notes[region] = f"{region.replace('_', ' + ')}: {value}"
        rows.append((region.replace("_", " + "), str(view.mean(region, "psnr")[1]), *cells))
    columns = ("region", "frames", *(TITLES[m] for m in shown))
    return Table(view.name, columns, rows, [*notes.values(), *view.protocol.footnotes()])


def geometry_table(geometry: Mapping[str, Value]) -> Table:
    """A row per computed measure; notes explain the others."""
    rows: list[tuple[str, ...]] = []
    reasons: dict[str, list[str]] = {}
    for name, title in GEOMETRY.items():
        value = geometry[name]
        if isinstance(value, NotComputed):
            reasons.setdefault(str(value), []).append(title.rpartition(" ")[0].rpartition(" ")[0])
        else:
            rows.append((title, f"{value:.6f}" if name == "cd_best" else f"{value:.2f}"))
    notes = [f"{', '.join(titles)}: {reason}" for reason, titles in reasons.items()]
    return Table("geometry", ("measure", "mean"), rows, [*notes, *(GEOMETRY_NOTES if rows else ())])


def timing_table(timing: Timing | NotComputed) -> Table:
    columns = ("deform ms", "raster ms", "total ms", "frames/s", "Gaussians drawn")
    if isinstance(timing, NotComputed):
        return Table("render time", columns, [], [str(timing)])
    numbers = (timing.deform_ms, timing.raster_ms, timing.total_ms, timing.fps)
    note = (
        f"Median of {timing.frames} synchronised frames after {timing.warmup}, at "
        f"{timing.width}x{timing.height}, by {timing.rasterizer} on {timing.device}; {timing.note}."
    )
    row = (*(f"{n:.2f}" for n in numbers), f"{timing.drawn:,}")
    return Table("render time", columns, [row], [note])


def size_table(parts: Sequence[PartSize]) -> Table:
    rows = [(p.name, p.kind, p.gaussians, p.parameters, p.megabytes) for p in parts]
    gaussians, parameters, megabytes = (sum(column) for column in list(zip(*rows))[2:])
    rows.append(("total", "", gaussians, parameters, megabytes))
    cells = []
    for name, kind, count, numbers, mb in rows:
        shown = "–" if kind in ("interaction", "decoder") else f"{count:,}"
        cells.append((name, kind, shown, f"{numbers:,}", f"{mb:.2f}"))
    notes = ["Parameters are trained numbers; MB are 10^6 bytes of all stored tensors, unpacked."]
    return Table("model size", ("part", "kind", "Gaussians", "parameters", "MB"), cells, notes)


def _plain(value: Value) -> float | dict[str, str]:
    return to_json(value if isinstance(value, NotComputed) else round(value, 6))
