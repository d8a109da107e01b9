"""Conformance of exporters: `CHECKS`, on a tiny synthetic scene."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.model.exporter import SHEET, Exported, Exporter, ExportRequest
from hoigs.core.reporting import Progress, no_progress
from hoigs.testing.checks import CheckError, CheckList, ComponentSubject, require
from hoigs.testing.material import HUMAN, OBJECT, TinyBody, moment_at, tiny_clip, tiny_scene
from hoigs.testing.modules import unchanged
from hoigs.testing.runner import Options

TIMES = (0.0, 0.5, 1.0)


@dataclass(frozen=True)
class ExporterSubject(ComponentSubject[Exporter]):
    """The component under check."""

    def exporter(self) -> Exporter:
        return self.cls.from_config(self.config, BuildContext())

    def request(self, *entities: str) -> ExportRequest:
        """Three moments of a scene with a human and an object, or some of these."""
        moments, bodies = tuple(map(moment_at, TIMES)), {HUMAN: TinyBody()}
        return ExportRequest(tiny_scene(), tiny_clip(), moments, entities, bodies)

    def export(
        self, out: Path, request: ExportRequest | None = None, progress: Progress = no_progress
    ) -> Exported:
        return self.exporter().export(request or self.request(), out, progress)


@contextlib.contextmanager
def workplace() -> Iterator[Path]:
    """An empty folder for exports; the working directory is another empty folder."""
    with tempfile.TemporaryDirectory() as root:
        place, elsewhere = Path(root) / "exports", Path(root) / "working-directory"
        place.mkdir()
        elsewhere.mkdir()
        with contextlib.chdir(elsewhere):
            yield place


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder`, hidden ones too, and every folder as b""."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else b""
        for path in sorted(folder.rglob("*"))
    }


CHECKS: CheckList[ExporterSubject] = CheckList("X")


def subject(cls: type[Exporter], config: Any, options: Options) -> ExporterSubject:
    made = ExporterSubject(cls, config)
    made.exporter()
    return made


# X01 to X05: the files of an export.


@CHECKS.check("X01")
def it_writes_a_file(subject: ExporterSubject) -> str:
    """An export writes at least one file that is not empty."""
    with workplace() as place:
        subject.export(place / "scene")
        found = contents(place / "scene").items()
        written = {name: data for name, data in found if data and name != SHEET}
        require(written, "the folder has no file, or only empty files")
    return ", ".join(sorted(written)[:4])


@CHECKS.check("X02")
def the_report_is_true(subject: ExporterSubject) -> None:
    """The folder, files and sizes that it returns are those on disk."""
    with workplace() as place:
        out = place / "scene"
        report = subject.export(out)
        require(report.folder == out, f"it reports the folder {report.folder}, expected {out}")
        files = {p.relative_to(out).as_posix(): p for p in out.rglob("*") if p.is_file()}
        sizes = {name: path.stat().st_size for name, path in files.items()}
        wrong = sorted(set(sizes.items()) ^ set(report.files.items()))
        require(not wrong, f"files and sizes that are reported or on disk, not both: {wrong}")


@CHECKS.check("X03")
def nothing_is_written_elsewhere(subject: ExporterSubject) -> None:
    """Nothing changes beside the new folder and in the working directory."""
    with workplace() as place:
        (place / "other.txt").write_text("another file")
        subject.export(place / "scene")
        root = place.parent
        after = {n: d for n, d in contents(root).items() if not n.startswith("exports/scene")}
        before = {"exports": b"", "exports/other.txt": b"another file", "working-directory": b""}
        changed = sorted(n for n in before | after if before.get(n) != after.get(n))
        require(not changed, f"exporting changed {changed} beside the new folder")


@CHECKS.check("X04")
def existing_paths_are_refused(subject: ExporterSubject) -> None:
    """A folder, a file or a link in the place of the new folder is refused and stays."""
    with workplace() as place:
        (place / "folder").mkdir()
        (place / "folder" / "mine.txt").write_text("mine")
        (place / "file").write_text("mine")
        (place / "link").symlink_to(place / "absent")
        before = contents(place)
        for name in ("folder", "file", "link"):
            try:
                subject.export(place / name)
            except HoigsError as error:
                require(name in str(error), f"the error does not name the {name}: {error}")
            except Exception as error:
                raise CheckError(f"a {name} there: {error!r}, expected a HoigsError") from error
            else:
                raise CheckError(f"it writes where a {name} is")
            require(contents(place) == before, f"the {name} that was there has changed")


class _StoppedError(Exception):
    """Raised in the middle of an export."""


@CHECKS.check("X05")
def a_failure_leaves_nothing(subject: ExporterSubject) -> None:
    """An export that fails leaves nothing behind, whenever it fails."""
    calls: list[float] = []
    with workplace() as place:
        subject.export(place / "whole", progress=lambda done, _: calls.append(done))
    for stop in range(len(calls)):
        with workplace() as place:
            _stopped_export(subject, place / "scene", stop)
            left = sorted(contents(place))
            require(not left, f"stopped at report {stop + 1} of {len(calls)}, it leaves {left}")


def _stopped_export(subject: ExporterSubject, out: Path, stop: int) -> None:
    count = 0

    def progress(done: float, text: str) -> None:
        nonlocal count
        if count == stop:
            raise _StoppedError
        count += 1

    try:
        subject.export(out, progress=progress)
    except _StoppedError:
        return
    raise CheckError(f"an error in report {stop + 1} of its progress does not reach the caller")


# X06 to X10: determinism, unmodified inputs, progress, and omissions.


@CHECKS.check("X06")
def output_is_deterministic(subject: ExporterSubject) -> None:
    """The same scene, exported twice under two names, gives the same bytes."""
    with workplace() as place:
        for name in ("one", "two"):
            subject.export(place / name)
        one, two = contents(place / "one"), contents(place / "two")
        other = sorted(n for n in one | two if one.get(n) != two.get(n))
        require(not other, f"exported twice, {other} differ")


def _inputs(request: ExportRequest) -> dict[str, Tensor]:
    clip, scene = request.clip, request.scene
    found = {f"scene.{n}": x for n, x in scene.state_dict().items()}
    found |= {f"clip.{n}": getattr(clip, n) for n in ("points", "point_colors")}
    for moment in request.moments:
        for name, pose in moment.poses.items():
            found |= {f"pose of {name} at {moment.time}: {n}": x for n, x in vars(pose).items()}
    found["torch's random state"] = torch.get_rng_state()
    return {name: x for name, x in found.items() if isinstance(x, Tensor)}


@CHECKS.check("X07")
def inputs_are_not_modified(subject: ExporterSubject) -> None:
    """Parameters, modes, clip, poses and torch's random state are as before."""
    for training in (True, False):
        request = subject.request()
        request.scene.train(training)
        with workplace() as place, unchanged("", partial(_inputs, request)):
            subject.export(place / "scene", request)
        modes = {module.training for module in request.scene.modules()}
        require(modes == {training}, f"exporting changed the scene's mode from {training}")
        gradients = [n for n, p in request.scene.named_parameters() if p.grad is not None]
        require(not gradients, f"exporting left gradients on {gradients}")


@CHECKS.check("X08")
def progress_never_falls(subject: ExporterSubject) -> None:
    """Progress lies in [0, 1], never falls and ends at 1."""
    calls: list[float] = []
    with workplace() as place:
        subject.export(place / "scene", progress=lambda done, _: calls.append(done))
    require(calls and calls[-1] == 1, f"progress ends at {calls[-1:]}, expected 1")
    require(calls == sorted(calls) and calls[0] >= 0, f"progress goes {calls}")


@CHECKS.check("X09")
def omissions_have_reasons(subject: ExporterSubject) -> str:
    """What the format cannot hold is reported by name, each with a reason."""
    with workplace() as place:
        omitted = subject.export(place / "scene").omitted
    bare = [what for what, why in omitted.items() if not (what.strip() and why.strip())]
    require(not bare, f"omitted without a reason: {bare}")
    return "; ".join(f"{what}: {why}" for what, why in omitted.items())


@CHECKS.check("X10")
def only_what_is_requested(subject: ExporterSubject) -> None:
    """When one entity is exported, changing another changes no byte; changing it does."""
    exporter = subject.exporter()
    mine, other = (OBJECT, HUMAN) if "object" in exporter.kinds else (HUMAN, OBJECT)
    with workplace() as place:
        for name, changed in (("plain", None), ("other", other), ("own", mine)):
            request = subject.request(mine)
            if changed is not None:
                with torch.no_grad():
                    request.scene.entity(changed).means.add_(torch.tensor((0.25, 0.0, 0.0)))
            subject.export(place / name, request)
        plain, others, own = (contents(place / name) for name in ("plain", "other", "own"))
        require(plain == others, f"only {mine} was requested, but {other} is in the files too")
        if exporter.reads_gaussians:
            require(plain != own, f"moving {mine} changes no byte: it is not in the files")
        else:
            require(plain == own, f"reads_gaussians is False, but moving {mine} changes the files")
