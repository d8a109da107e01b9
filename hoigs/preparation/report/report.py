"""The report of a preparation: what was made, how well, and how far each part may be trusted."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from hoigs.preparation.report.diagnosis import MeasureDiagnostic, diagnose
from hoigs.preparation.report.measures import Measures
from hoigs.preparation.report.object_seen import named
from hoigs.preparation.report.page import report_page


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
        for name, known in self.objects_seen.items():
            rows += [(f"{name}: {what}", value, note) for what, value, note in named(known)]
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
        if self.unknown:
            lines += ["", "## Not known", ""]
            lines += [f"- **{what}**: {why}" for what, why in self.unknown.items()]
        if self.warnings:
            lines += ["", "## Beware", "", *(f"- {w}" for w in self.warnings)]
        return "\n".join(lines) + "\n"

    def save(self, folder: Path) -> None:
        """report.json, report.md and report.html."""
        (folder / "report.json").write_text(self.to_json(), encoding="utf-8")
        (folder / "report.md").write_text(self.to_markdown(), encoding="utf-8")
        page = report_page(self, self.diagnostics(), self.rows(), folder=folder)
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
