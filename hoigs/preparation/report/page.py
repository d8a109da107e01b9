"""report.html: one file, which has overlay.mp4 and object.jpg inside and loads nothing."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from hoigs.preparation.report.diagnosis import MeasureDiagnostic
from hoigs.preparation.report.measures import Measures

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
    folder: Path,
) -> str:
    """The page; `rows` are what, value and note of each measure, `folder` may have overlay.mp4 and
    object.jpg."""
    page = (resources.files(__package__) / "page.html").read_text(encoding="utf-8")
    camera = CAMERAS[report.camera]
    return Template(page).substitute(
        title=escape(report.name),
        lead=escape(
            f"{report.frames} frames of {report.video}, {report.width}×{report.height} at "
            f"{report.fps:g} a second, from {camera}."
        ),
        video=_within(_VIDEO, folder / "overlay.mp4") + _within(_OBJECT, folder / "object.jpg"),
        diagnostics="\n".join(map(_diagnostic, diagnostics)),
        plots=_plots(report),
        rows=_rows(rows),
        made=_rows(list(report.provenance.items())),
        warnings=_listed("Not known", [f"{what}: {why}" for what, why in report.unknown.items()])
        + _listed("Beware", report.warnings),
    )


_VIDEO = (
    "<video src='data:video/mp4;base64,{}' controls loop muted playsinline></video><p class='note'>"
    "The fitted body in blue, the masks' outlines in green and yellow, points of the object in "
    "magenta. If the body does not lie on the person here, nothing after it will be right.</p>"
)
_OBJECT = (
    "<img src='data:image/jpeg;base64,{}' alt='the object in one frame' width='100%'><p "
    "class='note'>What was taken for the object. If it is something else, run the same command "
    "with <code>--object X,Y@FRAME</code>, a point on it in pixels of the video: only what depends "
    "on the object is made again.</p>"
)


def _within(text: str, path: Path) -> str:
    """The text with the file's bytes; nothing where there is none."""
    return text.format(base64.b64encode(path.read_bytes()).decode()) if path.is_file() else ""


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
    for name, within in report.bodies_within.items():
        off = [None if v is None else 1000 * v for v in within.joints]
        plots.append(plot(f"Joints of {name} within, mm", {"": off}))
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


def _listed(title: str, texts: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<h2>{title}</h2><ul>{items}</ul>" if texts else ""
