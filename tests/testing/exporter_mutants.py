"""An exporter that is right, and exporters with one mistake each."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

from hoigs.core.config import ComponentConfig
from hoigs.core.model.exporter import Exported, Exporter
from hoigs.core.reporting import no_progress


class RightConfig(ComponentConfig):
    digits: int = 6


class Right(Exporter):
    """Centres as text, a file a moment: x y z in each line."""

    Config = RightConfig

    def __init__(self, config=None):
        self.config = config or RightConfig()

    def names(self, request):
        return request.entities

    def write(self, request, folder, progress):
        for i, moment in enumerate(request.moments):
            progress(i / len(request.moments), f"moment {i}")
            means = request.scene(moment).joined(self.names(request)).means
            lines = [" ".join(f"{x:.{self.config.digits}f}" for x in row) for row in means.tolist()]
            (folder / f"{i:05d}.xyz").write_text("\n".join(lines) + "\n")
        return {"colours": "the format holds positions alone"}


class EmptyFiles(Right):
    def export(self, request, out, progress=no_progress):
        report = super().export(request, out, progress)
        if len(request.entities) == 1:  # X10 has its own mutant
            return report
        for name in report.files:
            (out / name).write_bytes(b"")
        return replace(report, files=dict.fromkeys(report.files, 0))


class GuessesSizes(Right):
    def export(self, request, out, progress=no_progress):
        report = super().export(request, out, progress)
        return replace(report, files=dict.fromkeys(report.files, 100))


class LeavesALog(Right):
    def write(self, request, folder, progress):
        Path("export.log").write_text("started")
        return super().write(request, folder, progress)


class Overwrites(Right):
    def export(self, request, out, progress=no_progress):
        if out.is_dir():
            shutil.rmtree(out)
        return super().export(request, out, progress)


class WritesInPlace(Right):
    def export(self, request, out, progress=no_progress):
        if out.exists() or out.is_symlink():
            return super().export(request, out, progress)  # refuses
        out.mkdir()
        omitted = self.write(request, out, progress)
        progress(1.0, "written")
        return Exported(out, {p.name: p.stat().st_size for p in out.iterdir()}, omitted)


class Numbered(Right):
    count = itertools.count()

    def write(self, request, folder, progress):
        omitted = super().write(request, folder, progress)
        if len(request.entities) > 1:  # X10 has its own mutant
            (folder / "run.txt").write_text(str(next(self.count)))
        return omitted


class SetsEvalMode(Right):
    def write(self, request, folder, progress):
        request.scene.eval()
        return super().write(request, folder, progress)


class CountsAgain(Right):
    def write(self, request, folder, progress):
        progress(0.9, "checking")
        return super().write(request, folder, progress)


class GivesNoReason(Right):
    def write(self, request, folder, progress):
        return super().write(request, folder, progress) | {"normals": ""}


class TakesAll(Right):
    def names(self, request):
        return request.scene.names()


MUTANTS = {
    "X01": EmptyFiles,
    "X02": GuessesSizes,
    "X03": LeavesALog,
    "X04": Overwrites,
    "X05": WritesInPlace,
    "X06": Numbered,
    "X07": SetsEvalMode,
    "X08": CountsAgain,
    "X09": GivesNoReason,
    "X10": TakesAll,
}
