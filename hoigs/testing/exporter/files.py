"""X01 to X05: the files of an export."""

from __future__ import annotations

from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.model.exporter import SHEET
from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require
from hoigs.testing.exporter.subject import CHECKS, ExporterSubject, contents, workplace


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
        before = {
            "exports": b"",
            "exports/other.txt": b"another file",
            "working-directory": b"",
        }
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
        del done, text
        if count == stop:
            raise _StoppedError
        count += 1

    try:
        subject.export(out, progress=progress)
    except _StoppedError:
        return
    raise CheckError(f"an error in report {stop + 1} of its progress does not reach the caller")
