"""What was prepared, how well, and how far each part may be trusted."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hoigs.preparation.findings import Finding, findings
from hoigs.preparation.report_page import report_page


@dataclass(frozen=True)
class PrepareReport:
    """Numbers to judge a prepared clip by; written as report.json, .md and .html beside it.

    Attributes:
        name, frames, width, height, fps: of the clip. video: the source's file name.
        camera: "static" or "moving". parallax_degrees: largest angle between two views of the
            scene's middle; under about 5 the geometry is weakly known.
        coverage: by entity, part of the image that the mask covers in each frame, 0..1.
        body_residual_px: median distance of fitted to given landmarks, in frame pixels.
        body: whatever else the body fit reports.
        scene_scale: metres a COLMAP unit; 1 for a static camera.
        object_scale_spread: standard deviation over frames of the object's apparent over its
            expected size: 0.05 means that its depth is uncertain by about 5 %.
        object_observed: part of the frames in which the object was seen.
        scene_points: number of points that start the background.
        provenance: what each part was made from, and how weak it is.
        warnings: what a reader should know before training.
        seconds: time by stage.
        registered: part of the chosen frames that have a camera; None for a static camera.
        reprojection_px: of COLMAP's points, mean; None for a static camera.
        displacement_px: of a static camera's background, at a width of 640; None if not measured.
        sharpness: of each frame (`sharpness.sharpness`).
        body_residuals_px: of each frame; None without landmarks.
        body_residual_m: `body_residual_px` at the person's distance.
        depth_residual: typical relative error of the depth prior once it is in metres, against
            `depth_against`; depth_residuals: of each frame. None without such a prior.
        omega, big_omega: effective multi-view factors (`multiview`).
    """

    name: str
    video: str
    frames: int
    width: int
    height: int
    fps: float
    camera: str
    parallax_degrees: float
    coverage: dict[str, list[float]]
    body_residual_px: float
    scene_scale: float
    object_scale_spread: float
    object_observed: float
    scene_points: int
    body: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    registered: float | None = None
    reprojection_px: float | None = None
    displacement_px: float | None = None
    sharpness: list[float] = field(default_factory=list)
    body_residuals_px: list[float | None] = field(default_factory=list)
    body_residual_m: float | None = None
    depth_residual: float | None = None
    depth_residuals: list[float | None] = field(default_factory=list)
    depth_against: str = ""
    omega: float | None = None
    big_omega: float | None = None

    def findings(self) -> list[Finding]:
        """Its measures, judged, and what to do where they are bad."""
        return findings(self)

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2, allow_nan=False)

    def rows(self) -> list[tuple[str, str, str]]:
        """What, value and note of each measure."""
        rows = [
            ("video", self.video, ""),
            ("frames", f"{self.frames} of {self.width}x{self.height}", f"{self.fps:g} fps"),
            ("camera", self.camera, f"parallax {self.parallax_degrees:.1f} degrees"),
            ("body", f"{self.body_residual_px:.1f} px", "median distance from the landmarks"),
            ("scene scale", f"{self.scene_scale:.4g}", "metres a unit of the source"),
            ("object seen", f"{100 * self.object_observed:.0f} %", "of the frames"),
            ("object scale spread", f"{100 * self.object_scale_spread:.1f} %", "so its depth's"),
            ("scene points", f"{self.scene_points}", ""),
        ]
        if self.depth_residual is not None:
            rows.append(
                ("depth", f"{100 * self.depth_residual:.1f} %", f"off {self.depth_against}")
            )
        if self.omega is not None:
            rows.append(("multi-view", f"{self.omega:.1f} °/s", "the camera around the person"))
        rows += [(f"mask of {n}", *_coverage(c)) for n, c in self.coverage.items()]
        rows.append(("time", f"{sum(self.seconds.values()):.0f} s", _times(self.seconds)))
        return rows

    def to_markdown(self) -> str:
        table = "\n".join(f"| {what} | {value} | {note} |" for what, value, note in self.rows())
        made = "\n".join(f"- **{name}**: {text}" for name, text in self.provenance.items())
        lines = [f"# {self.name}", "", "| | | |", "|---|---|---|", table]
        lines += ["", "## Made from", "", made]
        todo = [f for f in self.findings() if f.advice]
        if todo:
            told = (f"- **{f.what}: {f.value}** ({f.state}), {f.meaning}: {f.advice}" for f in todo)
            lines += ["", "## What to do", "", *told]
        if self.warnings:
            lines += ["", "## Beware", "", *(f"- {w}" for w in self.warnings)]
        return "\n".join(lines) + "\n"

    def save(self, folder: Path) -> None:
        """report.json, report.md and report.html."""
        (folder / "report.json").write_text(self.to_json(), encoding="utf-8")
        (folder / "report.md").write_text(self.to_markdown(), encoding="utf-8")
        page = report_page(self, (folder / "overlay.mp4").is_file())
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
