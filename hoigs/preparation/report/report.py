"""The report of a preparation: what was made, how well, and how far each part may be trusted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from hoigs.preparation.report.diagnostics import MeasureDiagnostic, Measures, diagnose

# report.html: one file, which loads nothing from the network but overlay.mp4 beside it.

WIDTH, HEIGHT = 300, 90  # of a plot, in its own units
Series = Mapping[str, Sequence[float | None]]
CAMERAS = {
    "static": "a camera that stands still", "turning": "a camera that turns on its spot",
    "moving": "a moving camera",
}  # fmt: skip


def report_page(
    report: Measures,
    diagnostics: Sequence[MeasureDiagnostic],
    rows: Sequence[Sequence[str]],
    *,
    overlay: bool,
    object_picture: bool = False,
) -> str:
    """The page; `rows` are what, value and note of each measure, `overlay` links overlay.mp4 and
    `object_picture` object.jpg."""
    page = (resources.files(__package__) / "page.html").read_text(encoding="utf-8")
    camera = CAMERAS[report.camera]
    return Template(page).substitute(
        title=escape(report.name),
        lead=escape(
            f"{report.frames} frames of {report.video}, {report.width}×{report.height} at "
            f"{report.fps:g} a second, from {camera}."
        ),
        video=(_video() if overlay else "") + (_object() if object_picture else ""),
        diagnostics="\n".join(map(_diagnostic, diagnostics)),
        plots=_plots(report),
        rows=_rows(rows),
        made=_rows(list(report.provenance.items())),
        warnings=_warnings(report.warnings),
    )


def _video() -> str:
    return (
        "<video src='overlay.mp4' controls loop muted playsinline></video><p class='note'>The "
        "fitted body in blue, the masks' outlines in green and yellow, points of the object in "
        "magenta. If the body does not lie on the person here, nothing after it will be right.</p>"
    )


def _object() -> str:
    return (
        "<img src='object.jpg' alt='the object in one frame' width='100%'><p class='note'>What was "
        "taken for the object. If it is something else, run the same command with <code>--object "
        "X,Y@FRAME</code>, a point on it in pixels of the video: only what depends on the object "
        "is made again.</p>"
    )


def _diagnostic(one: MeasureDiagnostic) -> str:
    advice = f"<p>{escape(one.do)}</p>" if one.do else ""
    return (
        f"<div class='diagnostic {one.severity}'><span><b>{escape(one.kind)}</b> "
        f"<small>{escape(one.what)}</small></span><em>{escape(one.value)} · "
        f"{one.severity}</em>{advice}</div>"
    )


def _plots(report: Measures) -> str:
    percent = {name: [100 * value for value in values] for name, values in report.coverage.items()}
    plots = [plot("Masks, % of the image", percent)]
    if report.sharpness:
        plots.append(plot("Sharpness", {"": report.sharpness}))
    if any(v is not None for v in report.body_residuals_px):
        plots.append(plot("Body off its landmarks, px", {"": report.body_residuals_px}))
    if any(v is not None for v in report.object_agreement):
        plots.append(plot("Object's texture against other frames", {"": report.object_agreement}))
    if any(v is not None for v in report.depth_residuals):
        off = [None if v is None else 100 * v for v in report.depth_residuals]
        plots.append(plot(f"Depth off {report.depth_against}, %", {"": off}))
    return "".join(plots)


def plot(title: str, series: Series) -> str:
    """Lines over the frames, from 0 to the largest value; None leaves a gap."""
    top = max((v for values in series.values() for v in values if v is not None), default=0.0)
    lines = []
    for values, style in zip(series.values(), "abab", strict=False):
        step = WIDTH / max(1, len(values) - 1)
        for run in _runs(values):
            points = " ".join(
                f"{i * step:.1f},{HEIGHT * (1 - value / (top or 1)):.1f}" for i, value in run
            )
            lines.append(f"<polyline class='{style}' points='{points}'/>")
    colours = zip(series, ("blue", "yellow", "blue", "yellow"), strict=False)
    legend = [f"{name} {colour}" for name, colour in colours if name]
    label = f"{title}, 0 to {top:.3g}" + (f"; {', '.join(legend)}" if legend else "")
    return (
        f"<figure><svg viewBox='0 -2 {WIDTH} {HEIGHT + 4}' preserveAspectRatio='none' role='img' "
        f"aria-label='{escape(label, quote=True)}'>{''.join(lines)}</svg>"
        f"<figcaption>{escape(label)}</figcaption></figure>"
    )


def _runs(values: Sequence[float | None]) -> list[list[tuple[int, float]]]:
    """Stretches without a gap, with frame numbers."""
    runs: list[list[tuple[int, float]]] = [[]]
    for i, value in enumerate(values):
        if value is None:
            runs.append([])
        else:
            runs[-1].append((i, value))
    # a line of one point shows nothing: it is drawn twice
    return [run * 2 if len(run) == 1 else run for run in runs if run]


def _rows(rows: Sequence[Sequence[str]]) -> str:
    cells = ("".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows)
    return "".join(f"<tr>{row}</tr>" for row in cells)


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return f"<h2>Beware</h2><ul>{items}</ul>"


@dataclass(frozen=True)
class PrepareReport(Measures):
    """Measures of a prepared clip, as report.json, report.md and report.html beside it."""

    def diagnostics(self) -> list[MeasureDiagnostic]:
        """Every measure that can be judged, and what to do where it is not good."""
        return diagnose(self)

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2, allow_nan=False)

    def rows(self) -> list[tuple[str, str, str]]:
        """What, value and note of each measure."""
        rows = [
            ("video", self.video, ""),
            ("frames", f"{self.frames} of {self.width}x{self.height}", f"{self.fps:g} fps"),
            ("camera", self.camera, f"parallax {self.parallax_degrees:.1f} degrees"),
            self._body_row("body", self.body_residual_px),
            *(self._body_row(n, m["body_residual_px"]) for n, m in self.further_people.items()),
            *(self._landmark_row(n) for n in self.landmarks),
            ("scene scale", f"{self.scene_scale:.4g}", "metres a unit of the source"),
        ]
        if self.object_observed is None or self.object_scale_spread is None:
            rows.append((self.object_name, "none", ""))
        else:
            name, spread = self.object_name, f"{100 * self.object_scale_spread:.1f} %"
            rows.append((f"{name} seen", f"{100 * self.object_observed:.0f} %", "of the frames"))
            rows.append((f"{name}'s scale spread", spread, "so its depth's"))
            rows.append((f"{name}'s poses", self.object_way, self.object_reason))
        for name, measured in self.further_objects.items():
            seen = f"{100 * measured['object_observed']:.0f} %"
            rows.append((f"{name} seen", seen, "of the frames"))
            rows.append((f"{name}'s poses", measured["object_way"], measured["object_reason"]))
        rows.append(("scene points", f"{self.scene_points}", ""))
        if self.depth_residual is not None:
            rows.append(
                ("depth", f"{100 * self.depth_residual:.1f} %", f"off {self.depth_against}")
            )
        if self.omega is not None:
            rows.append(("multi-view", f"{self.omega:.1f} °/s", "the camera around the person"))
        rows += [(f"mask of {n}", *_coverage(c)) for n, c in self.coverage.items()]
        rows.append(("time", f"{sum(self.seconds.values()):.0f} s", _times(self.seconds)))
        return rows

    @staticmethod
    def _body_row(name: str, residual: float | None) -> tuple[str, str, str]:
        if residual is None:
            return name, "none", "nobody was looked for"
        return name, f"{residual:.1f} px", "median distance from the landmarks"

    def _landmark_row(self, name: str) -> tuple[str, str, str]:
        of = self.landmarks[name]
        lost, repaired = (sum(map(len, of[key].values())) for key in ("lost", "repaired"))
        note = f"{lost} lost, {repaired} not found at once"
        return f"landmarks of {name}", f"{of['found']} of {self.frames} frames", note

    def to_markdown(self) -> str:
        table = "\n".join(f"| {what} | {value} | {note} |" for what, value, note in self.rows())
        made = "\n".join(f"- **{name}**: {text}" for name, text in self.provenance.items())
        lines = [f"# {self.name}", "", "| | | |", "|---|---|---|", table]
        lines += ["", "## Made from", "", made]
        todo = [
            f"- **{d.kind}: {d.value}** ({d.severity}), {d}" for d in self.diagnostics() if d.do
        ]
        if todo:
            lines += ["", "## What to do", "", *todo]
        if self.warnings:
            lines += ["", "## Beware", "", *(f"- {w}" for w in self.warnings)]
        return "\n".join(lines) + "\n"

    def save(self, folder: Path) -> None:
        """report.json, report.md and report.html."""
        (folder / "report.json").write_text(self.to_json(), encoding="utf-8")
        (folder / "report.md").write_text(self.to_markdown(), encoding="utf-8")
        page = report_page(
            self,
            self.diagnostics(),
            self.rows(),
            overlay=(folder / "overlay.mp4").is_file(),
            object_picture=(folder / "object.jpg").is_file(),
        )
        (folder / "report.html").write_text(page, encoding="utf-8")


_BARS = "▁▂▃▄▅▆▇█"


def _coverage(values: list[float]) -> tuple[str, str]:
    """Mean part of the image; a sparkline over time, the maximum and the empty frames."""
    if not values:
        return "no frames", ""
    top = max(values) or 1.0
    chosen = [values[i * len(values) // 32] for i in range(32)] if len(values) > 32 else values
    line = "".join(_BARS[min(7, int(8 * v / top))] if v else " " for v in chosen)
    empty = sum(v == 0 for v in values)
    note = f", empty in {empty} frames" if empty else ""
    mean = sum(values) / len(values)
    return f"{100 * mean:.1f} %", f"of the image, {line} up to {100 * top:.1f} %{note}"


def _times(seconds: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
